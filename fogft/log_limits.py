"""Which of many like events are worth a line in the log. Pure."""

from __future__ import annotations


def worth_logging(count: int) -> bool:
    """Whether the `count`-th event of its kind is: the 1st, 2nd, 4th, 8th, ... are."""
    return count > 0 and count & (count - 1) == 0
