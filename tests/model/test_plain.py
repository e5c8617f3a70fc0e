"""Reading JSON data as classes, by several threads at once."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import make_dataclass
from threading import Barrier

from fogft.model.plain import from_plain

THREADS = 4


def test_threads_that_read_the_first_of_a_class_at_once_all_read_it() -> None:
    """As links do that are answered their first probes together."""
    together = Barrier(THREADS)

    def read(cls: type) -> object:
        together.wait()
        return from_plain(cls, {"of": {"parts": ["it"]}})

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(THREADS) as threads:
            for _ in range(100):
                inner = make_dataclass("Inner", [("parts", tuple[str, ...])])
                outer = make_dataclass("Outer", [("of", inner)])
                right = outer(inner(("it",)))
                assert list(threads.map(read, [outer] * THREADS)) == [right] * THREADS
    finally:
        sys.setswitchinterval(interval)
