"""The journal: what was asked of SkyPilot survives whatever happens to this process."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fogft.cloud.sky.journal import Entry, Journal, Stage
from fogft.disk import write_whole
from fogft.errors import StateError
from fogft.model.replica import ReplicaId
from tests.fakes.sky import EAST, replica
from tests.nightly import by_day


def entry(id: ReplicaId | None = None) -> Entry:
    return Entry(id or replica(), EAST, 0.02, "abcd", 1000.0)


def test_an_entry_is_read_back_as_it_was(tmp_path: Path):
    journal = Journal(tmp_path)
    journal.open(entry(), {})
    changed = journal.update(replica(), stage=Stage.SETTING_UP, job=3, request="r1")
    assert Journal(tmp_path).entries() == [changed]


@settings(max_examples=by_day(30, at_night=500), deadline=None)
@given(st.lists(st.sampled_from(list(Stage)), max_size=8))
def test_a_stage_never_moves_back(tmp_path_factory: pytest.TempPathFactory, stages: list[Stage]):
    """A follower that is late cannot bring an ended launch back to life."""
    journal = Journal(tmp_path_factory.mktemp("journal"))
    journal.open(entry(), {})
    order = list(Stage)
    reached = 0
    for stage in stages:
        after = journal.update(replica(), stage=stage)
        assert after is not None
        reached = max(reached, order.index(stage))
        assert order.index(after.stage) == reached


def test_a_closed_entry_is_not_brought_back_by_an_update(tmp_path: Path):
    journal = Journal(tmp_path)
    journal.open(entry(), {"replica.key": b"k"})
    journal.close(replica())
    assert journal.update(replica(), stage=Stage.RUNNING) is None
    assert not journal.entries()
    assert not journal.files(replica()).exists()


def test_files_that_could_not_be_written_belong_to_an_entry_that_is_listed(tmp_path, monkeypatch):
    """Else the key of a launch that was cut short would lie there for ever."""
    journal, write = Journal(tmp_path), write_whole

    def killed(*_args, **_options):
        raise KeyboardInterrupt

    def full(path, content):
        write(path, content)
        raise StateError("no space is left")

    monkeypatch.setattr("fogft.cloud.sky.journal.write_whole", full)
    with pytest.raises(StateError):
        journal.open(entry(), {"replica.key": b"k"})
    assert (journal.entries(), journal.files(replica()).exists()) == ([], False)
    monkeypatch.setattr("fogft.cloud.sky.journal.write_whole", killed)
    with pytest.raises(KeyboardInterrupt):
        journal.open(entry(), {"replica.key": b"k"})
    [left] = journal.entries()
    journal.close(left.id)
    assert not journal.files(replica()).exists()


def test_entries_of_one_pool(tmp_path: Path):
    journal = Journal(tmp_path)
    other = replica(uid="00000000000000bb")
    for id in (replica(1), replica(0), other):
        journal.open(entry(id), {})
    assert [e.id for e in journal.entries(replica().pool_uid)] == [replica(0), replica(1)]
    assert len(journal.entries()) == 3


@pytest.mark.parametrize("content", ["", "{}", '{"id": 1}', "[]", '{"stage": "x"}'])
def test_a_damaged_entry_is_an_error_and_not_a_lost_machine(tmp_path: Path, content: str):
    journal = Journal(tmp_path)
    journal.open(entry(), {})
    (tmp_path / "fogft-00000000000000aa-0-1.json").write_text(content)
    with pytest.raises(StateError):
        journal.entries()
