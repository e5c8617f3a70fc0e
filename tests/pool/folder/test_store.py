"""What is on disk: whole or not at all, remembered before it is done, readable after a crash."""

from __future__ import annotations

import errno
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft import disk
from fogft.errors import PoolNotFound, StateError
from fogft.model.intent import Intent
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Membership
from fogft.planning.observed import history
from fogft.planning.observed.history import Event, EventKind
from fogft.pool.folder import history_file, lease
from fogft.pool.folder.store import read_identity
from tests.pool.scene import Scene, store_of

LAUNCH = Event(1.0, EventKind.LAUNCH, 0, 1, "c/r/a", Reason(Cause.NEW_SLOT))
READY = Event(2.0, EventKind.READY, 0, 1)


@pytest.fixture
def pool(scene: Scene) -> Scene:
    """A pool as `up` writes it, without a manager."""
    scene.write()
    return scene


def test_history_outlives_the_process(pool: Scene) -> None:
    """Another store over the same folder knows what the first one wrote."""
    pool.store.append(LAUNCH)
    pool.store.append(READY)
    other = store_of(pool.home)
    assert other.recent() == [LAUNCH, READY]
    assert other.history().generations[0] == 1
    assert pool.paths.history.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("torn", ["{", '{"at": 3, "kind": "rea', "\x00\x00\x00", "null"])
def test_torn_last_line_costs_that_line_only(pool: Scene, torn: str) -> None:
    """A crash in the middle of a write loses nothing before it and nothing after it."""
    pool.store.append(LAUNCH)
    with pool.paths.history.open("a") as file:
        file.write(torn)
    other = store_of(pool.home)
    assert other.recent() == [LAUNCH]
    other.append(READY)
    assert store_of(pool.home).recent() == [LAUNCH, READY]


def test_on_a_full_disk_nothing_is_launched_and_all_else_is_written_later(
    pool: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A launch that could not be written is not in the history, on disk or in memory."""
    pool.store.append(LAUNCH)
    second = replace(LAUNCH, generation=2)
    ended = [Event(3.0, kind, 0, 1) for kind in (EventKind.ENDING, EventKind.ENDED)]

    def full(descriptor: int, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        with pytest.raises(StateError, match="No space left"):
            pool.store.append(second)
        for event in ended:
            pool.store.append(event)
        with pytest.raises(StateError, match="No space left"):
            pool.store.append(second)
    assert pool.store.history().generations[0] == 1
    assert pool.store.history().open() == []
    assert store_of(pool.home).recent() == [LAUNCH]
    assert pool.store.flush() is None  # though nothing more happens
    assert store_of(pool.home).recent() == [LAUNCH, *ended]
    pool.store.append(second)
    assert store_of(pool.home).recent() == [LAUNCH, *ended, second]


def test_an_event_that_is_not_safe_on_the_disk_is_there_once(
    pool: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    pool.store.append(LAUNCH)

    def unsafe(descriptor: int) -> None:
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", unsafe)
        pool.store.append(READY)
    pool.store.append(Event(4.0, EventKind.UNREADY, 0, 1))
    assert [event.kind for event in store_of(pool.home).recent()] == [
        EventKind.LAUNCH, EventKind.READY, EventKind.UNREADY,
    ]  # fmt: skip


def test_half_written_event_is_taken_back(pool: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """When the disk takes only half a line, the half is cut off again."""
    pool.store.append(LAUNCH)
    before = pool.paths.history.read_bytes()
    write = os.write
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", lambda d, data: write(d, data[:10]))
        with pytest.raises(StateError):
            pool.store.append(replace(LAUNCH, generation=2))
    assert pool.paths.history.read_bytes() == before


def test_history_is_compacted_as_it_grows(pool: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A year of flapping does not fill the disk, and keeps generations and readiness."""
    monkeypatch.setattr(history_file, "COMPACT_AFTER", 50)
    monkeypatch.setattr(os, "fsync", lambda _: None)
    pool.store.append(LAUNCH)
    for at in range(200):
        kind = EventKind.UNREADY if at % 2 else EventKind.READY
        pool.store.append(Event(float(at), kind, 0, 1))
    assert len(pool.paths.history.read_text().splitlines()) < 60
    record = store_of(pool.home).history().record(0, 1)
    assert record is not None
    assert (record.first_ready_at, record.unready_since) == (0.0, 199.0)


def test_who_reads_a_long_history_loses_nothing_of_what_its_manager_writes_meanwhile(
    pool: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `fogft up` does on a pool that is managed; the next manager makes the file shorter."""
    pool.store.append(LAUNCH)
    for at in range(20):
        pool.store.append(Event(float(at), (EventKind.READY, EventKind.UNREADY)[at % 2], 0, 1))
    later = replace(LAUNCH, generation=2)

    def compacted(*given: Any) -> list[Event]:
        kept = history.compacted(*given)
        pool.store.append(later)
        return kept

    with monkeypatch.context() as patch:
        patch.setattr(history_file, "compacted", compacted)
        store_of(pool.home).history()
    assert pool.store.recent(1) == [later]
    successor = store_of(pool.home)
    assert successor.history().generations[0] == 2
    successor.append(replace(READY, generation=2))
    assert len(successor.recent(100)) < 10


def test_intent_and_membership_round_trip(pool: Scene) -> None:
    """What is written is what is read."""
    intent = Intent(target=3, scaled_from=2, drained={1: 2}, excluded=frozenset({"c/r"}))
    pool.store.write_intent(intent)
    assert pool.store.intent() == intent
    membership = Membership("pool", "0" * 16, 2, 3)
    pool.store.write_membership(membership)
    assert pool.store.membership() == membership


def test_damaged_files_are_told_apart_from_missing_ones(pool: Scene) -> None:
    """A damaged intent is an error, a missing one is empty; a damaged membership is none."""
    pool.paths.intent.write_text("{")
    with pytest.raises(StateError, match="damaged"):
        pool.store.intent()
    pool.paths.intent.unlink()
    assert pool.store.intent() == Intent()
    pool.paths.membership.write_text('{"epoch": 1}')
    assert pool.store.membership() is None


@pytest.mark.parametrize(
    "damage", [{"uid": "short"}, {"uid": None}, {"created_at": "yesterday"}, {"name": ...}]
)
def test_damaged_identity_is_an_error(pool: Scene, damage: dict[str, object]) -> None:
    """Machines are ended by uid, so a uid that is not one is never used."""
    raw = {**disk.read_json(pool.paths.identity), **damage}
    pool.paths.identity.write_text(json.dumps({k: v for k, v in raw.items() if v is not ...}))
    with pytest.raises(StateError, match="damaged") as caught:
        read_identity(pool.paths)
    assert "fogft sweep --end" in caught.value.hint


def test_an_identity_of_another_user_is_not_to_be_removed(pool: Scene, monkeypatch) -> None:
    def denied(path: Path, *_: object, **__: object) -> str:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "read_text", denied)
    monkeypatch.setattr(Path, "read_bytes", denied)
    with pytest.raises(StateError, match="Permission denied") as caught:
        read_identity(pool.paths)
    assert caught.value.hint == "run fogft as the user who owns it"


@pytest.mark.parametrize("name", ["pool", "another"])
def test_a_damaged_identity_is_as_the_manager_told_it(pool: Scene, name: str) -> None:
    """So `fogft down` still ends the machines; what another pool's manager told is not taken."""
    before = read_identity(pool.paths)
    told = {"pool": name, "uid": before.uid, "cloud": before.cloud, "file": before.file, "epoch": 7}
    disk.write_json(pool.paths.status, told)
    pool.paths.identity.unlink()
    pool.paths.identity.mkdir()
    if name == "pool":
        after = read_identity(pool.paths)
        assert (after.uid, after.cloud, after.first_epoch) == (before.uid, before.cloud, 7)
        assert abs(after.created_at - before.created_at) < 60.0
    else:
        with pytest.raises(StateError):
            read_identity(pool.paths)


def test_no_pool_is_its_own_error(tmp_path: Path) -> None:
    """Asking for what is not there says so, with what to do."""
    with pytest.raises(PoolNotFound) as caught:
        store_of(tmp_path, "nothing").identity()
    assert "fogft up" in caught.value.hint


def test_spec_is_read_again_when_it_changes(pool: Scene) -> None:
    """The stored file is parsed once per content."""
    first = pool.store.spec()
    assert pool.store.spec() is first
    pool.write(replicas=3)
    assert pool.store.spec().replicas == 3


@given(after=st.integers(0, 2**50), restarts=st.integers(0, lease.TERM - 1))
def test_of_two_imports_one_is_the_later_and_no_restart_is(after: int, restarts: int) -> None:
    """Each supersedes what was before; a machine never supersedes itself."""
    one, other = lease.next_term(after), lease.next_term(after)
    assert lease.supersedes(one, after)
    assert lease.supersedes(other, after)
    assert one == other or lease.supersedes(max(one, other), min(one, other) + restarts)
    assert not lease.supersedes(min(one, other), max(one, other))
    assert not lease.supersedes(one + restarts, one)
    assert max(one, other) < 2**53  # what a record may count to
