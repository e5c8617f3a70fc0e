"""Where a robot hands its requests in, and how much lies there unanswered. Pure.

A request may lie at a replica long after its caller has given up. What lies at each is bounded,
so that its link has always room to look at it.

Owns: what was handed in where and has not ended. Not here: when (`shared_robot`).
"""

from __future__ import annotations

from collections.abc import Iterable

PLACE_LIMIT = 256
PLACE_BYTES = 16 << 20


class Places:
    """What one robot has handed in, by replica."""

    def __init__(self) -> None:
        self._lying: dict[int, dict[int, int]] = {}  # replica -> number -> size
        self._bytes: dict[int, int] = {}

    def choose(self, replicas: Iterable[int], seq: int, turn: int) -> int | None:
        """Return where to hand a request in; None where it lies everywhere, or no room is.

        Args:
            replicas: Those that take requests now.
            seq: The request's number.
            turn: How often it was handed in before: the next replica has its turn.
        """
        left = [r for r in replicas if self._has_room(r) and seq not in self._lying.get(r, ())]
        return left[turn % len(left)] if left else None

    def _has_room(self, replica: int) -> bool:
        few = len(self._lying.get(replica, ())) < PLACE_LIMIT
        return few and self._bytes.get(replica, 0) < PLACE_BYTES

    def begin(self, replica: int, seq: int, size: int) -> None:
        """A request is handed in."""
        self._lying.setdefault(replica, {})[seq] = size
        self._bytes[replica] = self._bytes.get(replica, 0) + size

    def end(self, replica: int, seq: int) -> None:
        """It lies there no more: it was answered, refused or lost."""
        lying = self._lying.get(replica, {})
        self._bytes[replica] = self._bytes.get(replica, 0) - lying.pop(seq, 0)
        if not lying:
            self._lying.pop(replica, None)
            self._bytes.pop(replica, None)
