"""When the pool's manager last gave a sign of life, as seen from a client proxy.

Owns: reading the manager's lease. Not here: what replicas do without a manager (`proxy.replica`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fogft import disk
from fogft.disk import Watched
from fogft.errors import StateError


class ManagerSign:
    """How long ago the pool's manager last gave a sign of life, by our own clock.

    The lease's `beat` counts up while the manager works; comparing counts instead of
    times makes it immune to a clock that jumps.
    """

    def __init__(self, lease: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._watched = Watched(lease)
        self._clock = clock
        self._beat: Any = None
        self._seen_at: float | None = None

    def look(self) -> None:
        """Read the lease if it has changed."""
        if not self._watched.changed():
            return
        try:
            lease = disk.read_json(self._watched.path)
        except StateError:
            return
        beat = (lease.get("epoch"), lease.get("beat")) if isinstance(lease, dict) else None
        if beat is not None and beat != self._beat:
            if self._beat is not None:  # the first reading may be of a manager long dead
                self._seen_at = self._clock()
            self._beat = beat

    def age_s(self) -> float | None:
        """Seconds since the last sign; None if there was none yet."""
        return None if self._seen_at is None else self._clock() - self._seen_at
