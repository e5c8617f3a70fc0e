"""A burst does not hold its memory for ever."""

from __future__ import annotations

import subprocess
import sys

from fogft.ros.memory_tuning import Trimmer
from tests.proxy.fakes import Clock


class Scene:
    def __init__(self, own: int) -> None:
        self.clock = Clock()
        self.own = own
        self.given = 0
        self.trimmer = Trimmer(100, 5.0, clock=self.clock, own=lambda: self.own, give=self.give)

    def give(self) -> None:
        self.given += 1


def test_a_large_process_gives_back_but_no_more_often_than_it_may():
    scene = Scene(own=200)
    for _ in range(20):
        scene.trimmer.look()
        scene.clock.now += 1.0
    assert scene.given == 3


def test_a_small_process_keeps_what_it_has():
    scene = Scene(own=100)
    scene.clock.now += 10.0
    assert not scene.trimmer.look()
    assert scene.given == 0


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
