"""Two threads that meet wherever they can: each has but a microsecond at a time."""

from __future__ import annotations

import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def meanwhile(changes: Callable[[], object], look: Callable[[], object]) -> None:
    """Have this thread `look` again and again until another one has made its `changes`."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(1) as other:
            changing = other.submit(changes)
            while not changing.done():
                look()
            changing.result()
    finally:
        sys.setswitchinterval(interval)
