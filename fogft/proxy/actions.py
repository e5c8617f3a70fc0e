"""An action on the robot: its three services, of which all replicas get every request.

The goal that a client makes goes to every replica, and to those that come while it is under
way: a goal outlives the replicas that it was given to. The first that succeeds is the result;
the others are then told to cancel. What a client cancels is cancelled everywhere.

Owns: how the parts of an action differ from plain services (`dispatcher`) and what they
share. Not here: feedback and status (`topics_robot`).
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

from fogft.core import goals
from fogft.core.first_response import Pending
from fogft.core.goals import Goals
from fogft.core.model import ReplicaId
from fogft.core.names import REQUEST_ID_BYTES
from fogft.core.spec import Part, ServiceSpec
from fogft.proxy.dispatcher import Dispatcher, key_of
from fogft.proxy.request import Request
from fogft.wire.port import Answer, Link, Refusal

log = logging.getLogger(__name__)

_CANCEL_S = 10.0


class Shared:
    """What the three services of one action share: its goals, under a lock."""

    def __init__(self) -> None:
        self.goals = Goals()
        self.lock = threading.Lock()


class PartDispatcher(Dispatcher):
    """A part of an action: its own idea of a success.

    Args:
        spec: The service.
        respond: Sends a response to the caller of a handle.
        shared: What the action's parts share.
        others: As for `Dispatcher`.
    """

    def __init__(
        self,
        spec: ServiceSpec,
        respond: Callable[[Any, bytes], None],
        shared: Shared,
        **others: Any,
    ) -> None:
        self._shared = shared
        self._part = spec.part
        super().__init__(spec, respond, **others)

    def _check(self, ok_field: str) -> Callable[[bytes], bool]:
        return lambda response: goals.is_success(self._part, response)


class ReachingAll(PartDispatcher):
    """`cancel_goal`: every replica gets each request, whoever was first."""

    def _forget(self, request: bytes, replicas: Iterable[int]) -> None:
        """Let the others go on: they shall all have it."""


class GoalDispatcher(ReachingAll):
    """`send_goal`: an accepted goal also goes to replicas that come before it has its result."""

    def answered(self, link: Link, answer: Answer) -> None:
        """Take the end of an attempt; remember what was accepted."""
        pending, payload = self._requests.get(answer.request_id), answer.payload
        if pending is not None and payload is not None and goals.is_success(Part.GOAL, payload):
            with self._shared.lock:  # before its client can know, and ask for the result
                self._shared.goals.accepted(pending.item.payload)
        super().answered(link, answer)

    def route(self, links: Sequence[Link]) -> None:
        """Give replicas that have come the goals that are under way."""
        before = set(self._links)
        super().route(links)
        for link in links:
            if key_of(link) not in before:
                self._catch_up(link)

    def _catch_up(self, link: Link) -> None:
        with self._shared.lock:
            under_way = self._shared.goals.requests
        for payload in under_way:
            id = os.urandom(REQUEST_ID_BYTES)
            if link.offer(self.spec.name, id, payload, self.spec.timeout_s):
                log.info("goal_sent_again service=%s replica=%s goal=%s", self.spec.name,
                         link.peer.id.short, goals.goal_of(payload).hex())  # fmt: skip


class ResultDispatcher(PartDispatcher):
    """`get_result`: the first replica that succeeds; the others are told to cancel the goal.

    Args:
        cancel: Name of the action's cancel service.
        others: As for `PartDispatcher`.
    """

    def __init__(self, *args: Any, cancel: str, **others: Any) -> None:
        super().__init__(*args, **others)
        self._cancel = cancel
        self._to_cancel: list[tuple[bytes, int]] = []

    def submit(self, payload: bytes, handle: Any) -> None:
        """Take a request for a result; its goal is under way until that comes."""
        with self._shared.lock:
            self._shared.goals.awaited(goals.goal_of(payload))
        super().submit(payload, handle)

    def answered(self, link: Link, answer: Answer) -> None:
        """Take a result. A replica that got the goal late may not know it yet: ask it again."""
        pending, payload = self._requests.get(answer.request_id), answer.payload
        if payload is None or pending is None:
            super().answered(link, answer)
            return
        goal = goals.goal_of(pending.item.payload)
        under_way = goal in self._shared.goals
        if under_way and goals.is_unknown(payload):
            super().answered(link, replace(answer, payload=None, refusal=Refusal.NOT_READY))
            return
        super().answered(link, answer)
        won = goals.is_success(Part.RESULT, payload) and answer.request_id not in self._requests
        if under_way and won:
            with self._lock:
                self._to_cancel += [(goal, key) for key in self._links if key != key_of(link)]
            self._wake()

    def _rejected(self, id: ReplicaId, replica: int, request: bytes, payload: bytes) -> None:
        """Keep the rejection that says more: that of a replica which knows the goal."""
        pending = self._requests.get(request)
        if pending is not None and pending.rejection is not None and goals.is_unknown(payload):
            payload = pending.rejection
        super()._rejected(id, replica, request, payload)

    def _close(self, request: bytes, pending: Pending[Request]) -> None:
        super()._close(request, pending)
        self._ended(pending)

    def _expired(self, request: bytes, pending: Pending[Request]) -> None:
        super()._expired(request, pending)
        self._ended(pending)

    def _ended(self, pending: Pending[Request]) -> None:
        with self._shared.lock:
            self._shared.goals.ended(goals.goal_of(pending.item.payload))

    def tick(self) -> float:
        """Also tell the losers to cancel."""
        with self._lock:
            due, self._to_cancel = self._to_cancel, []
        for goal, key in due:
            link = self._links.get(key)
            if link is not None:
                id = os.urandom(REQUEST_ID_BYTES)
                link.offer(self._cancel, id, goals.cancel_request(goal), _CANCEL_S)
        return super().tick()


class Actions:
    """Makes the dispatchers of actions, and has those of one action share what they must."""

    def __init__(self) -> None:
        self._shared: dict[str, Shared] = {}

    def make(
        self, spec: ServiceSpec, respond: Callable[[Any, bytes], None], wake: Callable[[], None]
    ) -> PartDispatcher:
        """Make the dispatcher of an action's part."""
        action = spec.name.rpartition("/")[0]
        shared = self._shared.setdefault(action, Shared())
        if spec.part is Part.GOAL:
            return GoalDispatcher(spec, respond, shared, wake=wake)
        if spec.part is Part.RESULT:
            cancel = f"{action}/cancel_goal"
            return ResultDispatcher(spec, respond, shared, wake=wake, cancel=cancel)
        return ReachingAll(spec, respond, shared, wake=wake)
