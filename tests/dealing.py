"""In which order tests begin, where several workers share them: the long ones first.

`pytest-xdist --dist worksteal` gives each worker a block of the list, and later what others have
left at the end of theirs. A long test at the end would be waited for alone. Long is a test that
sets a time limit of its own: it starts a whole pool.

Three blocks have long tests, as two cores can bear three pools, those first that take longest. The
others wait beside them for what needs little of a processor, longest first too, and then take what
does nothing but compute, which fills the time in which all pools wait.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

T = TypeVar("T")
POOLS = 3  # at a time


def dealt(
    tests: Sequence[T],
    limit_s: Callable[[T], float],
    takes_s: Callable[[T], float],
    computes: Callable[[T], bool],
    workers: int,
) -> list[T]:
    """Return the tests, so that each worker's block begins with its share of the long ones.

    Args:
        tests: All of them. Others than the long ones stay beside their neighbours, with whom
            they share fixtures.
        limit_s: A test's own time limit; 0 if it sets none.
        takes_s: About how long a test takes; 0 if not long.
        computes: Whether a test waits for nothing.
        workers: How many blocks.
    """
    long = sorted(filter(limit_s, tests), key=lambda t: (takes_s(t), limit_s(t)), reverse=True)
    others = sorted(
        (test for test in tests if not limit_s(test)),
        key=lambda t: (computes(t), takes_s(t)),
        reverse=True,
    )
    for_long = max(1, min(POOLS, workers - 1))
    out: list[T] = []
    for worker in range(workers):
        block = (len(tests) - len(out)) // (workers - worker)
        share = long[worker::for_long] if worker < for_long else []
        room = max(0, block - len(share))
        out += share + (others[:room] if worker < workers - 1 else others)
        del others[:room]
    return out
