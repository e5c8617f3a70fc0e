"""Which version of a stateful service is in office: whose answers count. Pure.

Replicas of another version stand by: they apply every request, and nobody sees their answers.
A version takes office by a change, from a snapshot of the one in office, or when that has left.

Owns: who is in office, who should be, and when the office counts as left.
Not here: carrying the change out (`sequencer`, `fogft.proxy.robot.ordered_dispatcher`).
Rules: docs/design/rolling-update.md.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

# So long the office may stand empty before those who stand by take it, without a snapshot: links
# that come up one after the other, and a service that restarts, shall not decide it.
VACANCY_S = 3.0


class Office:
    """The office of one service.

    Args:
        holder: The version in office; None while nobody ever was.
    """

    def __init__(self, holder: str | None = None) -> None:
        self.holder = holder
        self._empty_since: float | None = None
        self._vacant = False

    def believes(self, version: str) -> bool:
        """Whether answers of this version count."""
        return version == self.holder

    def may_lead(self, version: str) -> bool:
        """Whether a term may begin from the state of a replica of this version."""
        return self.holder is None or self._vacant or version == self.holder

    def look(self, joined: Iterable[str], now: float) -> None:
        """Note which versions the replicas have that apply what is sent to them."""
        if self.holder is None or self.holder in set(joined):
            self._empty_since, self._vacant = None, False
            return
        if self._empty_since is None:
            self._empty_since = now
        self._vacant = now - self._empty_since >= VACANCY_S

    def successor(self, joined: Iterable[str]) -> str | None:
        """Return who takes an office that has been left: most of those that stand by."""
        return _most(joined) if self._vacant else None

    def wish(self, staying: Iterable[str]) -> str | None:
        """Return which version should take over from the one in office; None for no change.

        Args:
            staying: The versions of those that apply what is sent to them, and are to stay.
        """
        counted = Counter(staying)
        best = _most(counted.elements())
        if best is None or self.holder is None or best == self.holder:
            return None
        return best if counted[best] > counted[self.holder] else None


def _most(versions: Iterable[str]) -> str | None:
    counted = Counter(versions)
    return max(counted, key=lambda version: (counted[version], version)) if counted else None
