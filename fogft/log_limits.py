"""Which of many similar events to log. Pure."""

from __future__ import annotations


def worth_logging(count: int) -> bool:
    """Whether to log the `count`-th event of its kind: the 1st, 2nd, 4th, 8th, ..."""
    return count > 0 and count & (count - 1) == 0
