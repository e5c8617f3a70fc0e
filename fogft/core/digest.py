"""Keep what follows from what happened at each place until it can be otherwise. Pure.

Owns: how long a result holds. Not here: what it is (`quarantine`) and what happened (`history`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

T = TypeVar("T")


@dataclass
class Lasting(Generic[T]):
    """Something that is so from `since` until before `until`, unless something happens."""

    value: T
    since: float
    until: float


class Digest(Generic[T]):
    """What follows from the events of each of several places, kept as long as it is so.

    Args:
        outdated: Places to be worked out when next asked for.
    """

    def __init__(self, outdated: set[str]) -> None:
        self.outdated = outdated
        self._known: dict[str, Lasting[T | None]] = {}
        self._values: dict[str, T] = {}
        self._since, self._until = float("-inf"), float("inf")

    def at(self, now: float, work_out: Callable[[str], Lasting[T | None]]) -> Mapping[str, T]:
        """Return what is so at a time, by place; None is left out."""
        if not self._since <= now < self._until:
            self.outdated.update(
                place for place, one in self._known.items() if not one.since <= now < one.until
            )
        if self.outdated:
            for place in self.outdated:
                self._known[place] = work_out(place)
            self.outdated.clear()
            self._values = {p: one.value for p, one in self._known.items() if one.value is not None}
            self._since = max(one.since for one in self._known.values())
            self._until = min(one.until for one in self._known.values())
        return self._values


def outdate(digests: Mapping[Any, Digest[Any]], place: str) -> None:
    """Have a place worked out anew in all of them."""
    for digest in digests.values():
        digest.outdated.add(place)
