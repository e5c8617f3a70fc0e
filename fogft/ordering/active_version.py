"""Which version of a stateful service is active, so that its answers count. Pure.

Replicas of other versions are standbys: they apply every request, but their answers are discarded.
A version becomes active by a handover from a snapshot of the active one, or when that is gone.

Rules: docs/design/rolling-update.md. Not here: performing the change (`ordering.sequencer`).
"""

from collections import Counter
from collections.abc import Iterable

VACANCY_S = 3.0  # longer than links take to come up one after another, or a service to restart


class ActiveVersion:
    """The active version of one service; None until there is a first one."""

    def __init__(self, version: str | None = None) -> None:
        self.version = version
        self._gone_since: float | None = None
        self._is_gone = False

    def may_lead(self, version: str) -> bool:
        """Whether a term may begin from the state of a replica of this version."""
        return self.version is None or self._is_gone or version == self.version

    def look(self, joined: Iterable[str], now: float) -> None:
        """Note the versions of the replicas that apply orders."""
        if self.version is None or self.version in set(joined):
            self._gone_since, self._is_gone = None, False
            return
        if self._gone_since is None:
            self._gone_since = now
        self._is_gone = now - self._gone_since >= VACANCY_S

    def successor(self, joined: Iterable[str]) -> str | None:
        """Return the version that replaces one that is gone: that of most standbys."""
        return _most(joined) if self._is_gone else None

    def wanted(self, staying: Iterable[str]) -> str | None:
        """Return which version of those `staying` should take over; None for no change."""
        counted = Counter(staying)
        best = _most(counted.elements())
        if best is None or self.version is None or best == self.version:
            return None
        return best if counted[best] > counted[self.version] else None


def _most(versions: Iterable[str]) -> str | None:
    counted = Counter(versions)
    return max(counted, key=lambda version: (counted[version], version)) if counted else None
