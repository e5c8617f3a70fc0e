"""A burst does not hold its memory for ever."""

from __future__ import annotations

import subprocess
import sys

import pytest

from fogft.ros import memory_tuning
from tests.fakes.proxy import Clock


@pytest.mark.parametrize(("own", "times"), [(200, 3), (100, 0)])
def test_a_large_process_gives_back_but_no_more_often_than_it_may(own, times, monkeypatch):
    given = []
    monkeypatch.setattr(memory_tuning, "own_bytes", lambda: own)
    monkeypatch.setattr(memory_tuning, "give_back", lambda: given.append(own))
    clock = Clock()
    trimmer = memory_tuning.Trimmer(clock)
    trimmer.above_bytes = 100
    for _ in range(20):
        trimmer.look()
        clock.now += 1.0
    assert len(given) == times


def test_what_a_burst_left_is_really_given_back():
    """With large buffers kept by malloc, 64 freed ones stay until they are given back."""
    program = (
        "from fogft.ros import memory_tuning as m\n"
        "m.tune(); before = m.own_bytes()\n"
        "burst = [b'x' * (900_000 + n) for n in range(64)]; pin = b'x' * 900_000; del burst\n"
        "held = m.own_bytes() - before; m.give_back()\n"
        "print(held, m.own_bytes() - before)\n"
    )
    out = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout
    held, left = map(int, out.split())
    assert held > 50_000_000
    assert left < 10_000_000
