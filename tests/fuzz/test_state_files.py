"""Damaged files of the state folder, by seed: told or done without, never a trace."""

from __future__ import annotations

import contextlib
import json
import random
from collections.abc import Iterator

import pytest

from fogft.errors import FogftError
from tests.fuzz.mutation import damaged_text
from tests.fuzz.state_files import read_by, state_files
from tests.fuzz.targets import Target
from tests.nightly import by_day

CASES = by_day(6, at_night=2000)
IN_PLACE: dict[str, bytes] = {
    "nested too deep": b"[" * 200_000,
    "not UTF-8": b'{"\xe9": "\xff"}',
    "another kind": b"[[1, 2], {}]",
    "nothing": b"",
    "NUL": bytes(50),
    "a byte order mark": b"\xef\xbb\xbf{}",
    "UTF-16": '{"a": 1}'.encode("utf-16"),
    "a number": b"9" * 5000,
    "not a number": b"NaN",
    "null": b"null",
}
FILES = (
    "status.json", "proxy-status.json", "pool.json", "intent.json", "trial.json", "membership.json",
    "lease.json", "discovered.json", "records.json", "history.jsonl", "spec.yaml", "issued.json",
    "latency.json", "claims.json", "faults.json", "journal of SkyPilot", "lock of VMs",
    "trace",
)  # fmt: skip


@pytest.fixture(scope="module")
def targets() -> Iterator[dict[str, Target]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FOGFT_HOME", "")  # and back again afterwards
        yield state_files()


def test_each_file_is_damaged(targets: dict[str, Target]) -> None:
    assert set(targets) == set(FILES)
    assert all(target.run(target.seeds[0]) for target in targets.values())


@pytest.mark.parametrize("name", FILES)
def test_what_is_damaged_is_told_or_done_without(targets: dict[str, Target], name: str) -> None:
    """What a value is taken for is checked by who reads it first: no trace comes out."""
    target, dice = targets[name], random.Random(name)
    for _ in range(CASES):
        target.run(damaged_text(target.seeds[0], dice))


@pytest.mark.parametrize("name", FILES)
def test_what_stands_in_its_place_is_told_or_done_without(
    targets: dict[str, Target], name: str
) -> None:
    """A folder, a link to itself or to nothing, and what is no JSON of that file's kind."""
    path, good, read = read_by()[name]
    links = {"a link to itself": path, "a link to nothing": path.with_name("nothing")}
    kinds = ["a folder", *links, *IN_PLACE]
    for kind in kinds[: by_day(6, at_night=len(kinds))]:
        path.unlink()
        if kind in IN_PLACE:
            path.write_bytes(IN_PLACE[kind])
        elif kind in links:
            path.symlink_to(links[kind])
        else:
            path.mkdir()
        try:
            with contextlib.suppress(FogftError):
                read()
        finally:
            if path.is_dir() and not path.is_symlink():
                path.rmdir()
            path.unlink(missing_ok=True)
            path.write_bytes(good)


def test_the_link_of_a_gateway_may_tell_less(targets: dict[str, Target]) -> None:
    """Found by damaging: what has a default in the file has none where it is drawn."""
    told = json.loads(targets["status.json"].seeds[0])
    for link in told["topology"]["links"]:
        del link["rtt_s"], link["detail"]
    assert targets["status.json"].run(json.dumps(told).encode())
