"""What more than half of a group is. Pure: two majorities of one group share somebody."""

from __future__ import annotations

from collections.abc import Collection, Set


def is_majority(some: Set[int], members: Collection[int]) -> bool:
    """Whether these are more than half of the members. Nobody is no majority."""
    return 2 * len(some & set(members)) > len(members)
