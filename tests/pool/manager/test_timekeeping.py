"""A tick's time: one for all of it, and no jump of the clock is lost."""

from __future__ import annotations

import pytest

from fogft.errors import StateError
from fogft.planning.observed.clock_jumps import Reading, Watch
from fogft.planning.observed.history import Event, EventKind
from fogft.planning.rollout import Trial
from fogft.pool.manager import timekeeping
from fogft.pool.manager.timekeeping import Timekeeping
from fogft.pool.manager.updating import Updating
from tests.pool.scene import Scene


def test_this_machine_s_clocks_are_read_together() -> None:
    """Two readings one after the other show no jump, busy as the machine may be."""
    watch = Watch()
    assert [watch.look(timekeeping.read()) for _ in range(100)] == [None] * 100


def test_a_jump_that_cannot_be_written_down_is_written_later(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a full disk a tick fails rather than take the jump for time that passed."""
    scene.write()
    store, wall_s, awake_s = scene.store, [1e9], [0.0]
    store.write_trial(Trial("file", began_at=1e9))
    store.append(Event(1e9, EventKind.LAUNCH, 0, 1, "c/r/a"))
    time = Timekeeping(store, Updating(store), lambda: Reading(wall_s[0], awake_s[0], awake_s[0]))
    assert not time.look()
    wall_s[0], awake_s[0] = 1e9 + 3601, 1.0
    with monkeypatch.context() as patched:
        patched.setattr(store, "write_trial", _full_disk)
        with pytest.raises(StateError):
            time.look()
    wall_s[0], awake_s[0] = 1e9 + 3602, 2.0
    assert time.look()
    assert not time.look()
    record = store.history().record(0, 1)
    assert record is not None
    assert time.now - record.launched_at == pytest.approx(2.0, abs=2.0)
    assert store.trial().began_at == 1e9 + 3600
    assert time.watch.doubt_s == 3600.0


def _full_disk(trial: Trial) -> None:
    raise StateError("no space left")
