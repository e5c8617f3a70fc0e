"""The window: bounded, and each attempt ends once."""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import dataclass

from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from fogft.byte_limit import SMALL_BYTES
from fogft.link.window import (
    IGNORED_AFTER_S,
    IGNORED_LIMIT,
    LinkWindow,
    OpenAttempt,
    Unanswered,
)


@dataclass(eq=False)
class Attempt:
    request_id: bytes
    size: int
    payload: bytes | None = b""
    forgotten: bool = False


class WindowMachine(RuleBasedStateMachine):
    """A window beside a plain model of it: a list of what is open."""

    LIMIT, LIMIT_BYTES = 4, 4 * SMALL_BYTES

    def __init__(self) -> None:
        super().__init__()
        self.window: LinkWindow = LinkWindow()
        self.window.limit, self.window.large.limit = self.LIMIT, self.LIMIT_BYTES
        self.open: list[Attempt] = []
        self.all: list[Attempt] = []
        self.closed = False

    def large(self) -> int:
        return sum(a.size for a in self.open if a.size > SMALL_BYTES)

    @rule(number=st.integers(0, 6), size=st.integers(0, 6 * SMALL_BYTES))
    def admit(self, number: int, size: int) -> None:
        """What is small needs a place only; a large one the bytes, too, or to be the only one."""
        attempt = Attempt(bytes([number]), size)
        fits = not self.large() or self.large() + size <= self.LIMIT_BYTES
        room = len(self.open) < self.LIMIT and (size <= SMALL_BYTES or fits)
        known = any(a.request_id == attempt.request_id for a in self.open)
        expected = not self.closed and not known and room
        assert self.window.admit(attempt) is expected
        if expected:
            self.open.append(attempt)
            self.all.append(attempt)

    @precondition(lambda self: self.all)
    @rule(data=st.data())
    def remove(self, data: st.DataObject) -> None:
        attempt = data.draw(st.sampled_from(self.all))
        assert self.window.holds(attempt) is (attempt in self.open)
        assert self.window.remove(attempt) is (attempt in self.open)
        self.open = [a for a in self.open if a is not attempt]

    @rule(number=st.integers(0, 6))
    def forget(self, number: int) -> None:
        known = any(a.request_id == bytes([number]) for a in self.open)
        assert (self.window.forget(bytes([number])) is not None) is known
        self.open = [a for a in self.open if a.request_id != bytes([number])]

    @rule()
    def close(self) -> None:
        assert self.window.close() == self.open
        self.open, self.closed = [], True

    @invariant()
    def counts_are_right(self) -> None:
        assert len(self.window) == len(self.open)
        assert self.window.large.held == self.large()


TestWindow = WindowMachine.TestCase


@given(limit=st.integers(1, 20), extra=st.integers(1, 5))
def test_room_is_announced_once_after_a_refusal(limit: int, extra: int) -> None:
    """Only a window that declined something tells of room, and only once."""
    window: LinkWindow = LinkWindow()
    window.limit = limit
    attempts = [Attempt(bytes([n]), 1) for n in range(limit + extra)]
    taken = [window.admit(a) for a in attempts]
    assert taken == [True] * limit + [False] * extra
    announced = 0
    for attempt in attempts[:limit]:
        window.remove(attempt)
        announced += window.regained_room()
    assert announced == 1
    window.admit(attempts[0])
    window.remove(attempts[0])
    assert not window.regained_room()


def test_an_attempt_ends_once_whoever_comes_first() -> None:
    """Four threads end the same attempts; each end is granted to exactly one of them."""
    window: LinkWindow = LinkWindow()
    window.limit = 10_000
    attempts = [Attempt(n.to_bytes(4, "big"), 3) for n in range(5000)]
    assert all(window.admit(a) for a in attempts)
    granted: Counter[bytes] = Counter()
    lock = threading.Lock()

    def end_all(step: int) -> None:
        mine = [a.request_id for a in attempts[::step] if window.remove(a)]
        with lock:
            granted.update(mine)

    threads = [threading.Thread(target=end_all, args=(step,)) for step in (1, -1, 1, -1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(granted.values()) == {1}
    assert len(granted) == len(attempts)
    assert (len(window), window.large.held) == (0, 0)


@given(
    steps=st.lists(st.tuples(st.integers(0, 20), st.booleans(), st.floats(0.0, 30.0)), max_size=40)
)
def test_a_replica_ignores_what_it_never_ends_though_others_do(
    steps: list[tuple[int, bool, float]],
) -> None:
    """One that ends any of what it was sent, a cancelled one too, ignores nothing until then."""
    unanswered, now = Unanswered(), 0.0
    taken: dict[bytes, OpenAttempt] = {}
    counted: set[bytes] = set()  # since it last ended anything
    for number, elsewhere, passes_s in steps:
        id = bytes([number])
        if id in taken:
            assert unanswered.answered(id) is taken.pop(id)
            counted.clear()
        else:
            attempt = OpenAttempt("/s", id, None, 1, now, now + 1.0, elsewhere=elsewhere)
            taken[id] = attempt
            unanswered.add(attempt)
        overdue = {id for id, one in taken.items() if one.elsewhere}
        now += passes_s
        counted |= {id for id in overdue if now >= taken[id].deadline + IGNORED_AFTER_S}
        assert unanswered.are_ignored(now) == (len(counted) >= IGNORED_LIMIT)
        assert unanswered.answered(b"nobody's") is None
