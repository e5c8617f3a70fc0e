"""Turns: one at a time while all goes well, no matter for the others when it does not."""

from __future__ import annotations

import threading

from fogft.link.credit import LargeSendGate
from tests.link.wire_pool import wait_for


def test_turns_do_not_overlap() -> None:
    """With patience enough, no two threads have their turn at once."""
    gate = LargeSendGate()
    gate.patience_s = 60.0
    inside: list[int] = []
    most: list[int] = []

    def work() -> None:
        for _ in range(200):
            turn = gate.take()
            inside.append(1)
            most.append(len(inside))
            inside.pop()
            gate.give(turn)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert max(most) == 1
    assert len(most) == 800


def test_who_is_stuck_loses_the_turn() -> None:
    """The first to lose patience goes without; those after it have turns of their own."""
    gate = LargeSendGate()
    gate.patience_s = 0.001
    stuck = gate.take()
    assert stuck is not None
    assert gate.take() is None
    following = gate.take()
    assert following is not None
    gate.give(following)
    gate.give(stuck)
    again = gate.take()
    assert again is following
    gate.give(again)


def test_a_waiting_thread_gets_the_turn_that_ends() -> None:
    """It need not wait for its patience to end."""
    gate = LargeSendGate()
    gate.patience_s = 60.0
    mine = gate.take()
    got: list[object] = []
    waiting = threading.Thread(target=lambda: got.append(gate.take()))
    waiting.start()
    gate.give(mine)
    wait_for(lambda: got)
    waiting.join()
    assert got == [mine]
