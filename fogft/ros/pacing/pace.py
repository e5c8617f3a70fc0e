"""Decide when to send a response, so that no client's queue overflows. Pure: time is an argument.

All clients of a service share one response topic, and each has its own queue: of ten by default,
where the eleventh response pushes out the first, whichever client it is for. So a client's queue
depends on how many responses, to any client, were sent since the oldest of its own that it may not
have taken. What shows that it takes responses: docs/design/serialised-services.md.

Owns: this accounting. Not here: sending, probing, waiting (`pacer`).
"""

import math
from collections import deque
from collections.abc import Iterator
from enum import Enum, auto
from typing import Any

QUEUE = 10  # the depth of rmw_qos_profile_services_default
WINDOW = 5  # unconfirmed responses, while nothing shows how quickly a client takes them
PROBED_WINDOW = 8  # C++ executors answer a probe before they take a response, in the same turn
WINDOW_LIMIT = 64
PROBES = 4  # in flight at once
# Limits of what waits for one client. Further responses are sent at once, as by a fast service.
WAITING_LIMIT, WAITING_BYTES_LIMIT = 1024, 64 << 20
EVERY_S = 0.005  # per response: a burst is safe with a client that takes nothing for 25 ms
# A request may arrive before discovery has found its client. ROS waits 0.1 s per attempt.
FIND_LIMIT_S = 10.0
_QUIET_S = 0.05  # after this long without a request, a client must prove again that it is fast
_USUAL_GROWS = 4  # per `EVERY_S`, plus a twentieth of the open requests: faster is a burst
_CLIENTS_KEPT = 64
_PROBE_AGAIN_S = 1.0  # in case a probe was lost
_SILENT_S = 0.2  # a client that answers no probe for this long blocks only itself
_GIVEN_UP_S = 30.0  # after this long without an answer, responses are paced by time
# A client that takes more slowly than it asks stays behind. Once its oldest response has waited
# this long, the newest goes first: in order, each would arrive after its caller has given up.
BEHIND_S = 1.0


class Probing(Enum):
    """Whether a client's node answers probes."""

    UNASKED = auto()  # it never had two requests open
    ASKED = auto()
    YES = auto()
    NO = auto()


class ClientPace:
    """The pacing state of one client."""

    def __init__(self, now: float, sent: int) -> None:
        self.waiting: deque[tuple[Any, bytes, float]] = deque()  # handle, response, since when
        self.untaken: deque[int] = deque()  # its responses' numbers, oldest first
        self.probing = Probing.UNASKED
        self.probed_at: float | None = None  # since when a probe is unanswered
        self.finding_until: float | None = None  # None if discovery has found it
        self.find_again_at = now
        self.ask_again_at = now  # for whether its node answers probes
        self.asked_at = now
        self._probes: deque[int] = deque()  # the last response before each unanswered probe
        self._probe_again_at = now
        self._waiting_bytes = 0
        self._taken = sent  # all responses up to this number have left its queue
        self._open = 0  # requests without a response; one that never gets any is harmless
        # For clients whose node answers no probes.
        self._usual = WINDOW  # this many open requests are nothing new
        self._window = WINDOW
        self._proofs = 0
        self._refilled_at = self._grown_at = now

    @property
    def strict(self) -> bool:
        """Whether only probes count as progress."""
        return self.probing in (Probing.ASKED, Probing.YES)

    def requested(self, now: float, *, together: bool = False) -> None:
        """Record a request; `together`: with another, so it cannot react to a response."""
        self.refill(now)
        if now - self.asked_at > _QUIET_S:
            self._window, self._proofs, self._usual = WINDOW, 0, WINDOW
        if self._open == 0:
            self._usual = min(self._usual, WINDOW)
        self.asked_at = now
        self._open += 1
        together = together or self._open > 1
        if together and self.probing is Probing.UNASKED:
            self.probing = Probing.ASKED
        if together if self.strict else self._open > self._usual:
            # No progress: the client only asks for more, and it takes nothing during a burst.
            self._proofs, self._refilled_at = 0, now
        elif self.untaken:
            self._took(self.untaken[0])
            self._proofs += 1
            if self._proofs >= 4 * self._window:
                self._window, self._proofs = min(2 * self._window, WINDOW_LIMIT), 0

    def hold(self, handle: Any, payload: bytes, now: float) -> bool:
        """Queue a response; False if the queue is full."""
        whole = self._waiting_bytes + len(payload)
        if self.waiting and (len(self.waiting) >= WAITING_LIMIT or whole > WAITING_BYTES_LIMIT):
            return False
        self._waiting_bytes = whole
        self.waiting.append((handle, payload, now))
        return True

    def next(self, now: float) -> tuple[Any, bytes]:
        """Return the oldest queued response; the newest if the client is far behind."""
        behind = self.finding_until is None and now - self.waiting[0][2] > BEHIND_S
        handle, payload, _ = self.waiting.pop() if behind else self.waiting.popleft()
        self._waiting_bytes -= len(payload)
        return handle, payload

    def not_found(self, handle: Any, payload: bytes, now: float) -> None:
        """Requeue a response that was sent before the client was discovered."""
        self.waiting.appendleft((handle, payload, now))
        self._waiting_bytes += len(payload)
        self.finding_until = self.finding_until or now + FIND_LIMIT_S
        self.find_again_at = self.finding_until  # or as soon as discovery lists it
        self._open += 1
        self.untaken.clear()  # responses sent along with it were lost, too

    def give_up(self) -> None:
        """Drop what waits for a client that is never discovered: it is gone."""
        self.waiting.clear()
        self._waiting_bytes = 0

    def sent(self, number: int) -> None:
        """Record that a response to this client was sent."""
        if not self.untaken:  # others' responses that it has not taken precede it in its queue
            self._taken = min(max(self._taken, number - QUEUE), number - 1)
        self.untaken.append(number)
        self._open = max(self._open - 1, 0)

    def has_room(self, sent: int) -> bool:
        """Whether one more response fits in the client's queue."""
        return not self.untaken or sent + 1 < self.untaken[0] + self._size()

    def _size(self) -> int:
        if self.probing is Probing.NO:
            return self._window
        return PROBED_WINDOW if self.probing is Probing.YES else WINDOW

    def answered_probe(self, now: float) -> None:
        """Record an answered probe: the executor had a turn."""
        if self._probes:
            self._took(min(self._taken + 1, self._probes.popleft()))
        self.probed_at = now if self._probes else None

    def probes_due(self, now: float, sent: int) -> int:
        """Return how many probes to send now; they count as sent."""
        if self.probing is not Probing.YES or (self._probes and now < self._probe_again_at):
            return 0
        self._probes = deque([sent] * min(PROBES, len(self.untaken)))
        self._probe_again_at = now + _PROBE_AGAIN_S
        if self.probed_at is None:
            self.probed_at = now
        return len(self._probes)

    def silent(self, now: float, limit_s: float = _SILENT_S) -> bool:
        """Whether a probe has been unanswered for longer than `limit_s`."""
        return self.probed_at is not None and now - self.probed_at > limit_s

    def refill(self, now: float) -> None:
        """Update the estimates from elapsed time."""
        if now - self._refilled_at >= EVERY_S:
            steps = int((now - self._refilled_at) / EVERY_S)
            self._refilled_at += steps * EVERY_S
            if not self.strict or not self.untaken:
                self._took(self._taken + steps)
        if now - self._grown_at >= EVERY_S:
            steps = int((now - self._grown_at) / EVERY_S)
            self._grown_at += steps * EVERY_S
            grown = self._usual + steps * (_USUAL_GROWS + self._open // 20)
            self._usual = max(self._usual, min(grown, self._open + self._open // 4))
        if self.probed_at is not None and self.silent(now, _GIVEN_UP_S):
            self.probing, self.probed_at, self.ask_again_at = Probing.NO, None, math.inf
            self._probes.clear()

    def _took(self, number: int) -> None:
        self._taken = max(self._taken, number)
        while self.untaken and self.untaken[0] <= self._taken:
            self.untaken.popleft()


class Pace:
    """The pacing state of one service's clients."""

    def __init__(self) -> None:
        self.clients: dict[bytes, ClientPace] = {}
        self.sent = 0

    def client(self, id: bytes, now: float) -> ClientPace:
        """Return a client, adding it if new; the least recently active ones are forgotten."""
        pace = self.clients.get(id)
        if pace is None:
            if len(self.clients) >= _CLIENTS_KEPT:
                idle = [c for c, p in self.clients.items() if not p.waiting]
                idle = [c for c in idle if now > self.clients[c].asked_at + FIND_LIMIT_S]
                idle.sort(key=lambda c: self.clients[c].asked_at)
                for gone in idle[: _CLIENTS_KEPT // 2]:
                    del self.clients[gone]
            pace = self.clients[id] = ClientPace(now, self.sent)
        return pace

    def take(self, client: ClientPace, now: float) -> bool:
        """Whether a response to a client may be sent now; if so, it counts as sent."""
        if not client.untaken:
            client.refill(now)  # even if there is room: time must not accumulate
        if any(self.in_the_way(client, now)):
            return False
        self.send(client)
        return True

    def send(self, client: ClientPace) -> None:
        """Count a response as sent, even if there was no room."""
        self.sent += 1
        client.sent(self.sent)

    def in_the_way(self, client: ClientPace, now: float) -> Iterator[tuple[bytes, ClientPace]]:
        """Yield the clients whose queues block a response to this one."""
        for id, other in self.clients.items():
            if other.untaken:
                other.refill(now)
                if not other.has_room(self.sent) and (other is client or not other.silent(now)):
                    yield id, other
