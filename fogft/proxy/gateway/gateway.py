"""A gateway: to robots it is like a replica, and its service is a dispatcher over its own links.

A robot sends a request once; here it is fanned out. Its id goes on unchanged, so a copy that
came on another way joins the one under way, here or at the replica, and nothing is run
twice. So does the time that is left, and so does word that it is no longer wanted.

While no replica behind it can answer, it refuses what it holds, so that a robot with another
gateway asks that one instead of waiting here.

Owns: which requests of robots are under way, and whom each answer goes to.
Not here: fanning out (`dispatcher`), links (`client`), files and signals (`process`).
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Mapping
from queue import SimpleQueue
from typing import Any

from fogft.link.port import Incoming
from fogft.model.refusal import Refusal
from fogft.proxy.robot.dispatcher import Dispatcher

log = logging.getLogger(__name__)

# As long as a link takes to come back by itself, and no longer.
UNREADY_S = 0.5
_COPIES_LIMIT = 8  # of one request that wait for its answer: links that were opened anew


class Forwarded:
    """A request that passes through: who awaits its answer, and until when."""

    __slots__ = ("copies", "deadline", "id", "robot", "service")

    def __init__(self, incoming: Incoming, deadline: float) -> None:
        self.copies = [incoming]
        self.deadline = deadline
        self.id = incoming.request_id
        self.robot = incoming.robot
        self.service = incoming.service


class Forwarder:
    """Passes requests on, and each answer back to all that await it.

    Args:
        held: Requests under way at once; more are refused as overloaded.
        of_one: The same for one robot: nobody takes all the room.
        kept_bytes: Answers kept for copies that come later, in bytes together.

    Attributes:
        joined: Copies of requests that were known.
        refused: Refusals by reason.
    """

    def __init__(
        self,
        *,
        held: int = 2048,
        of_one: int = 512,
        kept_bytes: int = 16 << 20,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._held = held
        self._of_one = of_one
        self._kept_limit = kept_bytes
        self._clock = clock
        self._lock = threading.Lock()
        self._dispatchers: dict[str, Dispatcher] = {}
        self._ready: frozenset[str] = frozenset()
        self._unready_since: dict[str, float] = {}
        self._open: dict[bytes, Forwarded] = {}
        self._by_robot: Counter[str] = Counter()
        self._kept: OrderedDict[bytes, tuple[float, bytes]] = OrderedDict()
        self.kept_bytes = 0
        self._queue: SimpleQueue[Forwarded | None] = SimpleQueue()
        self.passed = 0
        self.joined = 0
        self.refused: Counter[Refusal] = Counter()

    def start(self) -> None:
        """Begin to pass on: on a thread of its own, since the wire's threads must not send."""
        threading.Thread(target=self._pass_on, name="fogft-forward", daemon=True).start()

    def use(self, service: str, dispatcher: Dispatcher) -> None:
        """Set the dispatcher of a service."""
        self._dispatchers[service] = dispatcher

    @property
    def in_flight(self) -> int:
        """Requests under way."""
        return len(self._open)

    # -- from robots (the wire's threads) -------------------------------------------------

    def request(self, incoming: Incoming) -> None:
        """Take a request from the wire. Never blocks."""
        now = self._clock()
        with self._lock:
            known = self._open.get(incoming.request_id)
            kept = self._kept.get(incoming.request_id)
            if known is not None or kept is not None:
                self.joined += 1
            if known is not None:
                known.copies.append(incoming)
                if len(known.copies) > _COPIES_LIMIT:
                    del known.copies[0]  # refused as lost: its link is long gone
                return
            reason = None if kept is not None else self._reason_to_refuse(incoming)
            if kept is None and reason is None:
                forwarded = Forwarded(incoming, now + incoming.remaining_s)
                self._open[forwarded.id] = forwarded
                self._by_robot[forwarded.robot] += 1
                self._queue.put(forwarded)
        if kept is not None:
            incoming.reply(kept[1])
        elif reason is not None:
            self._refuse(incoming, reason)

    def _reason_to_refuse(self, incoming: Incoming) -> Refusal | None:
        if incoming.remaining_s <= 0:
            return Refusal.EXPIRED
        if incoming.service not in self._ready:
            return Refusal.NOT_READY
        full = len(self._open) >= self._held or self._by_robot[incoming.robot] >= self._of_one
        return Refusal.OVERLOADED if full else None

    def _refuse(self, incoming: Incoming, reason: Refusal) -> None:
        self.refused[reason] += 1
        incoming.refuse(reason)

    def cancel(self, ids: Iterable[bytes]) -> None:
        """Stop what is no longer wanted, here and behind."""
        for id in ids:
            self._stop(id, Refusal.CANCELLED)

    def _stop(self, id: bytes, reason: Refusal) -> None:
        with self._lock:
            forwarded = self._take(id)
        if forwarded is None:
            return
        self._dispatchers[forwarded.service].cancel(id)
        for incoming in forwarded.copies:
            self._refuse(incoming, reason)

    def _take(self, id: bytes) -> Forwarded | None:
        """Take a request out. Under the lock."""
        forwarded = self._open.pop(id, None)
        if forwarded is not None:
            self._by_robot[forwarded.robot] -= 1
            if not self._by_robot[forwarded.robot]:
                del self._by_robot[forwarded.robot]
        return forwarded

    # -- to replicas ----------------------------------------------------------------------

    def _pass_on(self) -> None:
        while (forwarded := self._queue.get()) is not None:
            try:
                self._forward(forwarded)
            except Exception:  # in this thread nobody else would tell of it
                log.exception("request_not_passed_on request=%s", forwarded.id.hex())
                self._stop(forwarded.id, Refusal.LOST)

    def _forward(self, forwarded: Forwarded) -> None:
        if self._open.get(forwarded.id) is not forwarded:
            return  # stopped meanwhile
        payload = forwarded.copies[-1].payload
        left_s = forwarded.deadline - self._clock()
        if left_s <= 0:
            self._stop(forwarded.id, Refusal.EXPIRED)
            return
        dispatcher = self._dispatchers[forwarded.service]
        if not dispatcher.forward(forwarded.id, payload, forwarded, left_s):
            self._stop(forwarded.id, Refusal.OVERLOADED)
            return
        self.passed += 1
        if self._open.get(forwarded.id) is not forwarded:
            dispatcher.cancel(forwarded.id)  # stopped in between; answered is fine, too

    def pass_on_waiting(self) -> None:
        """Pass on what was taken; for tests without a thread."""
        while not self._queue.empty():
            forwarded = self._queue.get()
            if forwarded is not None:
                self._forward(forwarded)

    # -- from replicas (their links' threads) ---------------------------------------------

    def respond(self, handle: Any, payload: bytes) -> None:
        """Give an answer to all that await it, and keep it for copies that come later."""
        forwarded: Forwarded = handle
        with self._lock:
            if self._open.get(forwarded.id) is not forwarded:
                return
            self._take(forwarded.id)
            self._keep(forwarded, payload)
            more = bool(self._open)
        for incoming in forwarded.copies:
            incoming.reply(payload, more=more)

    def _keep(self, forwarded: Forwarded, payload: bytes) -> None:
        self._kept[forwarded.id] = (forwarded.deadline, payload)
        self.kept_bytes += len(payload)
        while self.kept_bytes > self._kept_limit or len(self._kept) > 4 * self._held:
            _, (_, oldest) = self._kept.popitem(last=False)
            self.kept_bytes -= len(oldest)

    # -- time -----------------------------------------------------------------------------

    def tick(self, ready: frozenset[str]) -> None:
        """Drop what is past its deadline, or has none `ready` to answer it. Call at 50 Hz."""
        now = self._clock()
        for name in ready:
            self._unready_since.pop(name, None)
        for name in self._dispatchers.keys() - ready:
            self._unready_since.setdefault(name, now)
        self._ready = ready
        hopeless = {n for n, since in self._unready_since.items() if now - since >= UNREADY_S}
        with self._lock:
            all_forwarded = list(self._open.values())
            while self._kept and next(iter(self._kept.values()))[0] <= now:
                _, (_, payload) = self._kept.popitem(last=False)
                self.kept_bytes -= len(payload)
        for forwarded in all_forwarded:
            if forwarded.deadline <= now:
                self._stop(forwarded.id, Refusal.EXPIRED)
            elif forwarded.service in hopeless:
                self._stop(forwarded.id, Refusal.NOT_READY)

    def report(self) -> dict[str, Any]:
        """Return counters since the start."""
        return {
            "in_flight": self.in_flight,
            "passed": self.passed,
            "joined": self.joined,
            "refused": {reason.value: count for reason, count in self.refused.items()},
        }

    def close(self) -> None:
        """Refuse what is under way, and stop."""
        for id in list(self._open):
            self._stop(id, Refusal.LOST)
        self._queue.put(None)


def numbers(report: Mapping[str, Any]) -> dict[str, float]:
    """Return a forwarder's counters as a probe's answer carries them."""
    refused = report["refused"]
    return {
        "held": report["in_flight"],
        "ran": report["passed"],
        "joined": report["joined"],
        **{reason: float(count) for reason, count in refused.items()},
    }
