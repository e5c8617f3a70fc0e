"""What a machine of these tests serves, and waiting: for conditions, never for a time."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")
# Without `site`: it needs the standard library only.
STAND_IN = (sys.executable, "-S", str(Path(__file__).with_name("stand_in.py")))


def wait_for(condition: Callable[[], T], limit_s: float = 30.0) -> T:
    """Return what a condition gives, once that is true."""
    end = time.monotonic() + limit_s
    while not (value := condition()):
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.01)
    return value
