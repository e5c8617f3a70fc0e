"""Watch whether whoever orders a shared service lives, by what its replicas tell. Pure.

A robot that does not sequence looks at every replica four times a second. Each tells whom it
obeys, and how much it has heard from there: a count that stands still means silence.

Owns: what was seen, and when it is time to claim. Not here: claiming (`shared_robot`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass

from fogft.core.majority import is_majority
from fogft.core.shared_orders import Standing

LOOK_EVERY_S = 0.25
STALE_S = 1.5
SILENCE_S = 2.0
FIRST_SILENCE_S = 0.2
LOOKS_LIMIT = 4


@dataclass
class _Seen:
    standing: Standing
    seen_at: float
    changed_at: float


class Watch:
    """What one robot has seen of a service's replicas.

    Args:
        patience: Between 0 and 1, by chance: two robots seldom claim together.
    """

    def __init__(self, patience: float) -> None:
        self.highest = 0  # the latest term that was seen
        self._patience = patience
        self._quiet_from = 0.0
        self._look_at = 0.0
        self._seen: dict[int, _Seen] = {}
        self._looks: Counter[int] = Counter()  # on their way

    def keep(self, replicas: Collection[int]) -> None:
        """Forget all replicas but these."""
        self._seen = {r: seen for r, seen in self._seen.items() if r in replicas}

    def begin(self, now: float, patience: float) -> None:
        """Watch from now on, after a term of our own."""
        self._patience, self._quiet_from, self._look_at = patience, now, now

    def is_due(self, now: float) -> bool:
        """Whether to look now; then not again for a while."""
        if now < self._look_at:
            return False
        self._look_at = now + LOOK_EVERY_S
        return True

    def looks_at(self, replica: int) -> bool:
        """Whether to look at a replica: not where several looks are on their way."""
        if self._looks[replica] >= LOOKS_LIMIT:
            return False
        self._looks[replica] += 1
        return True

    def looked(self, replica: int) -> None:
        """A look has ended, well or not."""
        self._looks[replica] -= 1

    def saw(self, replica: int, standing: Standing, now: float) -> None:
        """Take what a replica told."""
        before = self._seen.get(replica)
        changed_at = now
        if before is not None and _heard(before.standing) == _heard(standing):
            changed_at = before.changed_at
        self._seen[replica] = _Seen(standing, now, changed_at)
        self.highest = max(self.highest, standing.promised)

    def is_silent(self, replicas: Collection[int], now: float, *, founders: int | None) -> bool:
        """Whether most of the members have not heard of a sequencer for long.

        Args:
            replicas: Those that can be reached.
            now: In seconds.
            founders: How many replicas may begin a service without members; None for never.
        """
        fresh = self._fresh(now)
        known = _latest([seen.standing for seen in fresh.values()])
        first = not any(seen.standing.promised for seen in fresh.values())
        wait_s = (FIRST_SILENCE_S if first else SILENCE_S) * (1 + self._patience)
        silent = {
            seen.standing.member
            for seen in fresh.values()
            if now - max(seen.changed_at, self._quiet_from) >= wait_s
        }
        if known:
            return _are_most(silent, known)
        return founders is not None and len(silent) == len(replicas) >= founders

    def _fresh(self, now: float) -> dict[int, _Seen]:
        return {r: seen for r, seen in self._seen.items() if now - seen.seen_at < STALE_S}

    def places(self, now: float) -> list[int]:
        """Return the replicas that take what is handed in: those that obey the latest term."""
        joined = {r: s.standing.promised for r, s in self._fresh(now).items() if s.standing.joined}
        latest = max(joined.values(), default=0)
        return sorted(r for r, promised in joined.items() if promised == latest)

    @property
    def lives(self) -> bool:
        """Whether most of the members apply what a living sequencer orders."""
        living = [
            seen.standing
            for seen in self._seen.values()
            if seen.changed_at + SILENCE_S > seen.seen_at and seen.standing.joined
        ]
        return _are_most({s.member for s in living}, _latest(living))

    @property
    def members(self) -> int:
        """How many members the service has, as far as is seen."""
        known = _latest([seen.standing for seen in self._seen.values()])
        return max(map(len, known), default=0)

    @property
    def sequencer(self) -> str:
        """The robot that replicas obey; empty where none was seen."""
        standings = [seen.standing for seen in self._seen.values()]
        return max(standings, key=lambda s: s.promised).robot if standings else ""


def _latest(standings: Collection[Standing]) -> list[tuple[int, ...]]:
    """Return the members as those know them who obey the latest term: one may know of a change."""
    knowing = [s for s in standings if s.members]
    latest = max((s.promised for s in knowing), default=0)
    return [s.members for s in knowing if s.promised == latest]


def _are_most(some: set[int], known: list[tuple[int, ...]]) -> bool:
    """Whether these are a majority of the members, by what any of those says who know them."""
    return any(is_majority(some, members) for members in known)


def _heard(standing: Standing) -> tuple[int, int, int]:
    return standing.promised, standing.heard, standing.member
