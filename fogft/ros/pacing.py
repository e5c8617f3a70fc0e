"""Send responses no faster than an ordinary ROS client's queue can take.

An ordinary ROS client keeps the last ten responses that it has not taken yet and silently
loses more. A service answers one request after another, but a proxy answers in bursts: all
that a failover held up, at once. Nobody tells how deep a client's queue is or whether it
takes, but a client that asks again after it was answered does. So `WINDOW` responses may be
on their way to a client; each request of one that has no more open than it usually has, or
else each `EVERY_S`, makes room for another. A client that proves quick gets a wider window.

A response to a client that discovery has not found yet is sent again until it has.

Owns: when a response is sent. Not here: sending it (`entities`).
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from fogft.errors import RosError
from fogft.ros.port import NotFoundYet

log = logging.getLogger(__name__)

WINDOW = 5  # of the ten in rmw_qos_profile_services_default
WINDOW_LIMIT = 64
# What waits for one client; what comes beyond is sent at once, as a fast service would.
WAITING_LIMIT, WAITING_BYTES_LIMIT = 1024, 64 << 20
EVERY_S = 0.005  # so a burst may meet a client that takes nothing for 25 ms
_QUIET_S = 0.05  # after so long without a request a client must prove anew that it is quick
_USUAL_GROWS = 4  # each `EVERY_S`, and by a twentieth of what is open: faster is a burst
_CLIENTS_KEPT = 64
# A client may ask before discovery has told the way back to it. ROS waits 0.1 s a try.
_FIND_LIMIT_S = 10.0
_GUID_BYTES = 16


class Pace:
    """One client: how many responses it may not have taken yet. Pure; seconds come in."""

    def __init__(self, now: float) -> None:
        self.waiting: deque[tuple[Any, bytes]] = deque()
        self._waiting_bytes = 0
        self._open = 0  # asked and not answered; one that is never answered stays: no harm
        self._usual = WINDOW  # no more open than this is nothing new
        self._untaken = 0
        self._window = WINDOW
        self._proofs = 0
        self._refilled_at = self._grown_at = now
        self.asked_at = now

    def requested(self, now: float) -> None:
        """Note a request. Where it takes the place of another, that one's response was taken."""
        self._refill(now)
        if now - self.asked_at > _QUIET_S:
            self._window, self._proofs, self._usual = WINDOW, 0, WINDOW
        if self._open == 0:
            self._usual = min(self._usual, WINDOW)
        self.asked_at = now
        self._open += 1
        if self._open > self._usual:
            # It only asks for more, and who asks in a burst does not take meanwhile.
            self._proofs, self._refilled_at = 0, now
        elif self._untaken:
            self._untaken -= 1
            self._proofs += 1
            if self._proofs >= 4 * self._window:
                self._window, self._proofs = min(2 * self._window, WINDOW_LIMIT), 0

    def hold(self, handle: Any, payload: bytes) -> bool:
        """Have a response wait; False where too much waits already."""
        whole = self._waiting_bytes + len(payload)
        if self.waiting and (len(self.waiting) >= WAITING_LIMIT or whole > WAITING_BYTES_LIMIT):
            return False
        self._waiting_bytes = whole
        self.waiting.append((handle, payload))
        return True

    def next(self) -> tuple[Any, bytes]:
        """Return the response that waited for longest."""
        handle, payload = self.waiting.popleft()
        self._waiting_bytes -= len(payload)
        return handle, payload

    def take(self, now: float) -> bool:
        """Whether a response may be sent now; if so, it counts as sent."""
        self._refill(now)
        if self._untaken >= self._window:
            return False
        self._untaken += 1
        self._open = max(self._open - 1, 0)
        return True

    def wait_s(self, now: float) -> float:
        """Return how long until there is room, should no request come."""
        return max(self._refilled_at + EVERY_S - now, 0.0)

    def _refill(self, now: float) -> None:
        steps = int((now - self._refilled_at) / EVERY_S)
        if steps > 0:
            self._refilled_at += steps * EVERY_S
            self._untaken = max(self._untaken - steps, 0)
        steps = int((now - self._grown_at) / EVERY_S)
        if steps > 0:
            self._grown_at += steps * EVERY_S
            grown = self._usual + steps * (_USUAL_GROWS + self._open // 20)
            self._usual = max(self._usual, min(grown, self._open + self._open // 4))


class Pacer:
    """Sends the responses of one service, at each client's pace. Any thread.

    Args:
        send: Sends a response; may raise RosError.
    """

    def __init__(
        self, send: Callable[[Any, bytes], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._send = send
        self._clock = clock
        self._paces: dict[bytes, Pace] = {}
        self._held: dict[bytes, Pace] = {}  # those whose responses wait
        self._again: list[tuple[Any, bytes, float]] = []  # with when to give up
        self._wake = threading.Condition()
        self._thread: threading.Thread | None = None  # made when the first response waits
        self._closed = False

    @property
    def clients(self) -> int:
        """How many clients are remembered."""
        return len(self._paces)

    def requested(self, handle: Any) -> None:
        """Note a request as it is taken."""
        now = self._clock()
        client = _client(handle)
        with self._wake:
            pace = self._paces.get(client) or self._new(client, now)
            pace.requested(now)
            if pace.waiting:
                self._wake.notify()

    def respond(self, handle: Any, payload: bytes) -> None:
        """Send a response now, or as soon as its client can bear it.

        Raises:
            RosError: It was sent now, and ROS refused it.
        """
        now = self._clock()
        client = _client(handle)
        with self._wake:
            pace = self._paces.get(client) or self._new(client, now)
            if (pace.waiting or not pace.take(now)) and pace.hold(handle, payload):
                self._held[client] = pace
                self._begin()
                return
        self.try_now(handle, payload, now + _FIND_LIMIT_S)

    def try_now(self, handle: Any, payload: bytes, give_up_at: float) -> None:
        """Send now; once more later if the client is not found yet, until a time.

        Raises:
            NotFoundYet: It was not found in time.
        """
        try:
            self._send(handle, payload)
        except NotFoundYet:
            if self._clock() >= give_up_at:
                raise
            with self._wake:
                self._again.append((handle, payload, give_up_at))
                self._begin()

    def _new(self, client: bytes, now: float) -> Pace:
        if len(self._paces) >= _CLIENTS_KEPT:
            idle = [c for c, p in self._paces.items() if not p.waiting]
            idle.sort(key=lambda c: self._paces[c].asked_at)
            for gone in idle[: _CLIENTS_KEPT // 2]:
                del self._paces[gone]
        pace = self._paces[client] = Pace(now)
        return pace

    def _begin(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="ros-pacer", daemon=True)
            self._thread.start()
        self._wake.notify()

    def _run(self) -> None:
        while True:
            with self._wake:
                if self._again and not self._closed:
                    self._wake.wait(EVERY_S)
                while not (due := self._due()) and not self._closed:
                    now = self._clock()
                    waits = [pace.wait_s(now) for pace in self._held.values()]
                    self._wake.wait(min(waits, default=None))
                if self._closed:
                    return
            for handle, payload, give_up_at in due:
                try:
                    self.try_now(handle, payload, give_up_at)
                except RosError as error:
                    log.warning("response_refused reason=%r", error.message)

    def _due(self) -> list[tuple[Any, bytes, float]]:
        now = self._clock()
        due, self._again = self._again, []
        for client, pace in list(self._held.items()):
            while pace.waiting and pace.take(now):
                due.append((*pace.next(), now + _FIND_LIMIT_S))
            if not pace.waiting:
                del self._held[client]
        return due

    def close(self) -> None:
        """Send no more; what waits is dropped. Repeatable."""
        with self._wake:
            self._closed = True
            self._wake.notify()


def _client(handle: Any) -> bytes:
    """Return who asked. rclpy's own handles do not tell: those clients share a pace."""
    return handle[:_GUID_BYTES] if isinstance(handle, bytes) else b""
