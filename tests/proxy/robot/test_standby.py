"""Handing over to the standby, where that cannot be."""

from __future__ import annotations

from types import SimpleNamespace

from fogft import disk
from fogft.proxy.robot import standby


def test_a_standby_that_cannot_be_looked_at_is_not_handed_over_to(tmp_path, caplog):
    """The proxy ends as it would without one; no error ends it before its time."""
    config = SimpleNamespace(lock=tmp_path / "proxy.lock", dial_in="")
    disk.standby_lock(config.lock).mkdir()
    assert not standby.hand_over(config, proxy=None, callers=dict, release=lambda: None)
    assert "handover_failed" in caplog.text
