"""Ask the fallback service on the robot for what the replicas do not answer in time.

Works on the dispatcher's table and counters, under the dispatcher's lock: a request has one
end, whoever brings it about. When it is asked is `requests.fallback`'s to say.

Owns: calls of the fallback service. Not here: replicas (`dispatcher`).
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

from fogft.errors import RosError
from fogft.log_limits import worth_logging
from fogft.metrics.outcomes import Outcomes
from fogft.model.choices import FallbackSpec
from fogft.proxy.robot.request import Request, Story
from fogft.requests.fallback import Rescues
from fogft.requests.first_response import FirstResponse, Pending
from fogft.ros.port import RosClient

log = logging.getLogger(__name__)


@dataclass
class Shared:
    """What the rescuer shares with the dispatcher.

    Attributes:
        name: The service's name.
        lock: Held around all but calls.
        close: Takes a request out that the replicas shall stop working on. Under the lock.
        give: Sends a response to a caller.
        forget: Tells these replicas that a request is no longer wanted.
    """

    name: str
    lock: threading.Lock
    requests: FirstResponse[Request]
    outcomes: Outcomes
    accepts: Callable[[bytes], bool]
    clock: Callable[[], float]
    close: Callable[[bytes, Pending[Request], float], None]
    give: Callable[[Any, bytes], None]
    forget: Callable[[bytes, Iterable[int]], None]


class Rescuer:
    """The fallback of one service."""

    def __init__(self, shared: Shared, spec: FallbackSpec) -> None:
        self._shared = shared
        self._client: RosClient | None = None
        self._rescues: Rescues[Pending[Request]] = Rescues(spec)

    def __len__(self) -> int:
        """Count the requests past their deadline whose fallback is awaited."""
        return len(self._rescues)

    def follow(self, spec: FallbackSpec | None, client: RosClient | None) -> None:
        """Follow another spec; without one nothing more is asked before the deadline."""
        old = self._rescues.spec
        self._rescues.spec = spec or replace(old, after_s=None, while_none_ready=False)
        self._client = client

    # -- under the lock -------------------------------------------------------------------

    def submitted(self, request: bytes, now: float, *, able: bool) -> float:
        """Note a new request; return when the fallback may have to be asked next."""
        self._rescues.submitted(request, now)
        return self._rescues.look_at(able=able)

    def ended(self, request: bytes) -> None:
        """A replica has answered it."""
        self._rescues.ended(request)

    # -- without the lock -----------------------------------------------------------------

    def tick(self, now: float, *, able: bool) -> float:
        """Ask for what is due, and give up what is not answered in time; return when next."""
        shared = self._shared
        with shared.lock:
            found = [(r, shared.requests.get(r)) for r in self._rescues.due(now, able=able)]
            over = self._rescues.given_up(now)
            look_at = self._rescues.look_at(able=able)
        for request, pending in found:
            if pending is not None and not self._ask(request, pending.item.payload):
                with shared.lock:
                    self._rescues.failed(request)
        for request, pending in over:
            self._unanswered(request, pending)
        return look_at

    def expired(self, request: bytes, pending: Pending[Request]) -> None:
        """A request's deadline came: the fallback has the rest of the say."""
        shared = self._shared
        with shared.lock:
            must_ask = self._rescues.expired(request, pending, shared.clock())
        if must_ask and not self._ask(request, pending.item.payload):
            with shared.lock:
                ours = self._rescues.answered(request) is not None
            if ours:
                self._unanswered(request, pending)

    def _ask(self, request: bytes, payload: bytes) -> bool:
        client = self._client
        try:
            if client is not None and client.available():
                client.call(payload, lambda response: self._answered(request, response))
                return True
            reason = "nobody offers it"
        except RosError as error:
            reason = error.message
        with self._shared.lock:
            count = self._shared.outcomes.count
            count["fallback_failed"] += 1
            failed = count["fallback_failed"]
        if worth_logging(failed):
            log.warning(
                "fallback_not_asked service=%s reason=%r count=%d",
                self._shared.name, reason, failed,
            )  # fmt: skip
        return False

    def _answered(self, request: bytes, payload: bytes) -> None:
        """Take the fallback's response, on the thread that takes from ROS."""
        shared = self._shared
        now = shared.clock()
        try:
            ok = shared.accepts(payload)
        except RosError:
            ok = False
        with shared.lock:
            overdue = pending = self._rescues.answered(request)
            if not ok:
                shared.outcomes.count["fallback_failed"] += 1
            elif overdue is None:
                _, pending = shared.requests.succeeded(request, now)
                if pending is not None:
                    shared.close(request, pending, now)
            if ok and pending is not None:
                self._note(request, pending, "fallback")
        if pending is None:
            return  # a replica was first
        if not ok:
            self._unanswered(request, pending)
            return
        shared.give(pending.item.handle, payload)
        if overdue is None:
            shared.forget(request, tuple(pending.open))

    def _unanswered(self, request: bytes, pending: Pending[Request]) -> None:
        """The fallback had nothing either: return the rejection if there is one."""
        shared, response = self._shared, pending.rejection
        with shared.lock:
            self._note(request, pending, "silent" if response is None else "answered")
        if response is not None:
            shared.give(pending.item.handle, response)

    def _note(self, request: bytes, pending: Pending[Request], outcome: str) -> None:
        self._shared.outcomes.count[outcome] += 1
        now = self._shared.clock()
        note_end(self._shared.outcomes, request, pending, outcome=outcome, now=now)


def note_end(
    outcomes: Outcomes,
    request: bytes,
    pending: Pending[Request],
    *,
    outcome: str,
    now: float,
    replica: str = "",
) -> None:
    """Trace the end of a request, where that is wanted. Under the lock."""
    if outcomes.trace is None:
        return
    arrived, story = pending.item.arrived, pending.item.story or Story()
    asked = {key: begun - arrived for key, begun in story.asked.items()}
    took_s, refused = now - arrived, story.refused
    outcomes.note(request, outcome, took_s=took_s, asked=asked, refused=refused, replica=replica)
