"""Is a history of calls linearizable? Check by searching for an order that explains it.

After Wing and Gong (1993), with Lowe's memory of configurations that led nowhere (2017):
a depth-first search over which call took effect next, among those that no other call
had ended before. A call without an answer may have taken effect at any later time, or never.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any

Step = Callable[[Any, Any], tuple[Hashable, Any]]


@dataclass(frozen=True)
class Call:
    """One call as its caller saw it.

    Attributes:
        began: When it was sent.
        ended: When its answer came; infinite if none did.
        asked: What was asked.
        answer: What was answered; of no meaning where none came.
    """

    began: float
    asked: Any
    ended: float = math.inf
    answer: Any = None

    @property
    def answered(self) -> bool:
        return self.ended != math.inf


def linearizable(history: Sequence[Call], step: Step, start: Hashable) -> bool:
    """Whether some order of the calls, true to their times, gives every answer.

    Args:
        history: The calls, in any order.
        step: State and question in, next state (hashable) and answer out.
        start: The first state.
    """
    calls = sorted(history, key=lambda call: call.began)
    must = sum(1 << i for i, call in enumerate(calls) if call.answered)
    seen: set[tuple[int, Hashable]] = set()
    stack: list[tuple[int, Hashable]] = [(0, start)]
    while stack:
        done, state = stack.pop()
        if done & must == must:
            return True
        if (done, state) in seen:
            continue
        seen.add((done, state))
        for i in _next(calls, done):
            after, answer = step(state, calls[i].asked)
            if not calls[i].answered or answer == calls[i].answer:
                stack.append((done | 1 << i, after))
    return False


def _next(calls: Sequence[Call], done: int) -> list[int]:
    """Return the calls that may take effect next: none that is left ended before they began."""
    first_end = math.inf
    found = []
    left = ~done & (1 << len(calls)) - 1
    while left:
        lowest = left & -left
        left ^= lowest
        call = calls[i := lowest.bit_length() - 1]
        if call.began > first_end:
            break  # sorted: nor may any later one
        found.append(i)
        first_end = min(first_end, call.ended)
    return found


# -- the models of the tests' services --------------------------------------------------------


def counter(state: int, asked: tuple[str, int]) -> tuple[int, int]:
    """``("add", n)`` and ``("get", 0)``, both answered with the new sum."""
    kind, number = asked
    after = state + number if kind == "add" else state
    return after, after


def key_value(
    state: tuple[tuple[str, int], ...], asked: tuple[Any, ...]
) -> tuple[tuple[tuple[str, int], ...], int]:
    """``put key value`` answers the old value, ``get key`` the value; -1 where there is none."""
    values = dict(state)
    old = values.get(asked[1], -1)
    if asked[0] == "put":
        values[asked[1]] = asked[2]
    return tuple(sorted(values.items())), old
