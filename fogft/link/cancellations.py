"""Cancelled requests, until their replica has been told. No clock, no Zenoh.

Telling costs a message, and is worth it only where there is work to be saved. A request that
was sent a moment ago is most likely answered before the message is there. So a cancellation is told
at once if the request has been out for `WORTH_S` and the replica was told nothing for `EVERY_S`,
else with the next flush, and not at all if the answer comes first.

Owns: which ids are to be told. Each step is one operation on a dictionary, which is atomic.
"""

from __future__ import annotations

WORTH_S = 0.005
EVERY_S = 0.01  # under load each answer has a loser: they are told together
LIMIT = 4096  # what one message carries; further ones are not told, and their work is not saved


class Cancellations:
    """Ids of cancelled requests of which a replica is still to be told."""

    def __init__(self) -> None:
        self._ids: dict[bytes, None] = {}
        self._told_at = float("-inf")

    def __bool__(self) -> bool:
        return bool(self._ids)

    def add(self, request_id: bytes, sent_at: float, now: float) -> bool:
        """Note that what was sent at `sent_at` is not wanted; whether to tell at once."""
        if len(self._ids) < LIMIT:
            self._ids[request_id] = None
        if now - sent_at < WORTH_S or now - self._told_at < EVERY_S:
            return False
        self._told_at = now
        return True

    def answered(self, request_id: bytes) -> None:
        """Its answer came all the same: there is nothing to be told."""
        self._ids.pop(request_id, None)

    def take(self) -> list[bytes]:
        """Return what is to be told now, and forget it."""
        return [id for id in list(self._ids) if self._ids.pop(id, self) is None]
