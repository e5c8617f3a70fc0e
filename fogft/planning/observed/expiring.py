"""Keep what follows from what happened at each place until it can be otherwise. Pure.

Owns: how long a result holds. Not here: what it is (`backoff`) and what happened (`history`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Generic, TypeVar

T = TypeVar("T")
S = TypeVar("S")
_UNTIL = attrgetter("until")


@dataclass
class Expiring(Generic[T]):
    """Something that is so until before `until`, unless something happens."""

    value: T
    until: float


class TtlCache(Generic[T, S]):
    """What follows from the events of each of several places, kept as long as it is so.

    Args:
        outdated: Places to be worked out when next asked for.
        sum_up: Makes one answer of what is so at each place. Pure.
    """

    def __init__(self, outdated: set[str], sum_up: Callable[[Mapping[str, T]], S]) -> None:
        self.outdated = outdated
        self._sum_up = sum_up
        self._known: dict[str, Expiring[T | None]] = {}
        self._whole = sum_up({})
        self._since, self._until = float("-inf"), float("inf")

    def at(self, now: float, work_out: Callable[[str], Expiring[T | None]]) -> S:
        """Return what is so at a time, all places summed up; None at a place is left out."""
        if now < self._since:  # the clock was set back
            self.outdated.update(self._known)
        elif now >= self._until:
            self.outdated.update(place for place, one in self._known.items() if now >= one.until)
        if self.outdated:
            for place in self.outdated:
                self._known[place] = work_out(place)
            self.outdated.clear()
            self._since, self._until = now, min(map(_UNTIL, self._known.values()))
            self._whole = self._sum_up(
                {place: one.value for place, one in self._known.items() if one.value is not None}
            )
        return self._whole


def outdate(caches: Mapping[Any, TtlCache[Any, Any]], place: str) -> None:
    """Have a place worked out anew in all of them."""
    for cache in caches.values():
        cache.outdated.add(place)
