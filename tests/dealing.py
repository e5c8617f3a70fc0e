"""In which order tests begin, where several workers share them: the long ones first.

`pytest-xdist --dist worksteal` gives each worker a block of the list, and later what others have
left at the end of theirs. A long test at the end would be waited for alone. Long is a test that
sets a time limit of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

T = TypeVar("T")


def dealt(tests: Sequence[T], limit_s: Callable[[T], float], workers: int) -> list[T]:
    """Return the tests, so that each worker's block begins with its share of the long ones.

    Args:
        tests: All of them. The others stay in their order: they share fixtures with neighbours.
        limit_s: A test's own time limit; 0 if it sets none.
        workers: How many blocks.
    """
    long = sorted(filter(limit_s, tests), key=limit_s, reverse=True)
    others = [test for test in tests if not limit_s(test)]
    out: list[T] = []
    for worker in range(workers):
        block = (len(tests) - len(out)) // (workers - worker)
        share = long[workers - 1 - worker :: workers]  # later blocks are not smaller, as xdist's
        room = block - len(share)
        out += share + others[:room]
        del others[:room]
    return out
