"""What the client proxy keeps with a request: its bytes, its caller's handle, when it came."""

from __future__ import annotations

from typing import Any

from fogft.model.refusal import Refusal


class Story:
    """Who was asked for a traced request. Moments are on the dispatcher's clock, seconds.

    Attributes:
        asked: Each replica that took it, with the moment when it was asked first.
        refused: Each replica that refused it, with its last reason.
    """

    __slots__ = ("asked", "refused")

    def __init__(self) -> None:
        self.asked: dict[int, float] = {}
        self.refused: dict[int, Refusal] = {}

    def declined(self, replica: int, asked: float | None) -> None:
        """Take back that a replica was asked at this moment; it may have been before."""
        if self.asked.get(replica) == asked:
            self.asked.pop(replica, None)


class Request:
    """A caller's request. `arrived` is on the dispatcher's clock, seconds.

    Attributes:
        story: For the trace; None where it is not traced.
    """

    __slots__ = ("arrived", "handle", "payload", "story")

    def __init__(self, payload: bytes, handle: Any, arrived: float, *, traced: bool) -> None:
        self.payload = payload
        self.handle = handle
        self.arrived = arrived
        self.story = Story() if traced else None
