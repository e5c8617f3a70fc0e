"""What the client proxy keeps with a request: its bytes, its caller's handle, when it came."""

from __future__ import annotations

from typing import Any


class Request:
    """A caller's request. `arrived` is on the dispatcher's clock, seconds."""

    __slots__ = ("arrived", "handle", "payload")

    def __init__(self, payload: bytes, handle: Any, arrived: float) -> None:
        self.payload = payload
        self.handle = handle
        self.arrived = arrived
