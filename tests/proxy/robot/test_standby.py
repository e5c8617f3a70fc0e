"""Handing over to the standby, where that cannot be."""

from __future__ import annotations

import shutil
from types import SimpleNamespace

from fogft import disk
from fogft.proxy.robot import standby


def test_a_standby_that_cannot_be_looked_at_is_not_handed_over_to(tmp_path, caplog):
    """The proxy ends as it would without one; no error ends it before its time."""
    config = SimpleNamespace(lock=tmp_path / "proxy.lock", dial_in="")
    disk.standby_lock(config.lock).mkdir()
    assert not standby.hand_over(config, proxy=None, callers=dict, release=lambda: None)
    assert "handover_failed" in caplog.text


def test_a_proxy_that_hands_over_ends_with_its_pool(tmp_path):
    """`fogft down` finds it by no lock any more; what its callers wait for is at no replica."""
    folder = tmp_path / "pool"
    folder.mkdir()
    config = SimpleNamespace(
        pool="p", lock=folder / "proxy.lock", status=folder / "proxy-status.json", dial_in=""
    )
    steps = iter(range(10))

    def run_once() -> None:
        if next(steps) == 5:
            shutil.rmtree(folder)

    proxy = SimpleNamespace(
        run_once=run_once,
        begin_hand_over=lambda: None,
        take_no_more=lambda: None,
        hold=dict,
        waiting=lambda **_: 1,
    )
    next_in_line = disk.Lock(disk.standby_lock(config.lock))
    assert next_in_line.acquire(wait=False)
    assert standby.hand_over(config, proxy, callers=lambda: {"/s": 1}, release=lambda: None)
    assert next(steps) < 10
    assert not folder.exists()
    next_in_line.release()
