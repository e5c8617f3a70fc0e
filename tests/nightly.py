"""How much is tried: enough by day, more in `.ci/nightly`, which sets `FOGFT_NIGHTLY`."""

from __future__ import annotations

import os

NIGHTLY = bool(os.environ.get("FOGFT_NIGHTLY"))


def by_day(count: int, *, at_night: int) -> int:
    """Return how many seeds, examples or rounds to try in this run."""
    return at_night if NIGHTLY else count
