"""Damaged files of the state folder, by seed: told or done without, never a trace."""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest

from tests.fuzz.mutation import damaged_text
from tests.fuzz.state_files import state_files
from tests.fuzz.targets import Target
from tests.nightly import by_day

CASES = by_day(12, at_night=2000)
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
