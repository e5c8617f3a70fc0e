"""An action on the robot: its three services, of which all replicas get every request.

The goal that a client makes goes to every replica, and to those that come while it is under
way: a goal outlives the replicas that it was given to. The first that succeeds is the result;
the others are then told to cancel. What a client cancels is cancelled everywhere.

Owns: how goals and results differ from plain services (`dispatcher`). Not here: cancelling
(`action_cancel`), feedback and status (`topics`).
"""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from fogft.link.port import Answer, Link
from fogft.model.names import REQUEST_ID_BYTES
from fogft.model.refusal import Effect, Refusal
from fogft.model.replica import ReplicaId
from fogft.model.spec import Part, ServiceSpec
from fogft.proxy.robot.action_cancel import CancelDispatcher
from fogft.proxy.robot.action_part import PartDispatcher, ReachingAll, Shared
from fogft.proxy.robot.dispatcher import key_of
from fogft.proxy.robot.request import Request
from fogft.topics import goals
from fogft.topics.goals import Had, Took

log = logging.getLogger(__name__)


class GoalDispatcher(ReachingAll):
    """`send_goal`: until a goal has its result, each replica is given it that does not have it."""

    def forward(self, request: bytes, payload: bytes, handle: Any, timeout_s: float) -> bool:
        """Take a client's goal, and note who is given it."""
        goal, until = goals.goal_of(payload), self._clock() + timeout_s
        with self.shared.lock:
            self.shared.goals.made(payload, request, tuple(self._links), until)
        taken = super().forward(request, payload, handle, timeout_s)
        if not taken:
            self._is_over(goal)
        return taken

    def _declined(self, request: bytes, replica: int) -> None:
        with self.shared.lock:
            self.shared.goals.failed(request, replica, self._clock())
        super()._declined(request, replica)

    def answered(self, link: Link, answer: Answer) -> None:
        """Take the end of an attempt; remember who has the goal."""
        replica = key_of(link)
        took = self._took(answer, replica)  # before its client can know, and ask for the result
        if took is not None and took.goal is not None:
            if not took.in_vain:
                self.shared.began(took.goal, replica)
            else:
                with self.shared.lock:
                    self.shared.cancel(took.goal, (replica,), self._clock())
                self._wake()
        super().answered(link, answer)

    def _took(self, answer: Answer, replica: int) -> Took | None:
        id, payload, now = answer.request_id, answer.payload, self._clock()
        with self.shared.lock:
            if payload is None and answer.refusal is not Refusal.MALFORMED:
                self.shared.goals.failed(id, replica, now)
                return None
            accepts = payload is not None and goals.is_success(Part.GOAL, payload)
            return self.shared.goals.took(id, replica, now, accepts=accepts)

    def _is_over(self, goal: bytes) -> None:
        """Nobody was asked, or has answered: unless it was accepted, the goal is over, too."""
        with self.shared.lock:
            if goal not in self.shared.goals:
                self.shared.goals.ended(goal)

    def route(self, links: Sequence[Link]) -> None:
        """Give replicas that have come the goals that are under way."""
        before, after = dict(self._links), {key_of(link): link for link in links}
        come = [replica for replica, link in after.items() if before.get(replica) is not link]
        with self.shared.lock:
            for replica in before.keys() - after.keys():
                self.shared.goals.left(replica)
            for goal in self.shared.goals.unwanted():  # it may have missed that
                self.shared.cancel(goal, come, self._clock())
        super().route(links)
        self._catch_up()

    def tick(self) -> float:
        """Also give each replica the goals that it lacks."""
        self._catch_up()
        return super().tick()

    def _catch_up(self) -> None:
        now = self._clock()
        for replica, link in tuple(self._links.items()):
            with self.shared.lock:
                lacking = self.shared.goals.lacking(replica, now)
            for payload in lacking:
                self._give(replica, link, payload)

    def _give(self, replica: int, link: Link, payload: bytes) -> None:
        id, timeout_s = os.urandom(REQUEST_ID_BYTES), self.spec.timeout_s
        goal, now = goals.goal_of(payload), self._clock()
        with self.shared.lock:
            self.shared.goals.gave(goal, id, replica, now + timeout_s)
        if link.offer(self.spec.name, id, payload, timeout_s):
            log.info("goal_sent_again service=%s replica=%s goal=%s", self.spec.name,
                     link.peer.id.short, goal.hex())  # fmt: skip
            return
        with self.shared.lock:
            self.shared.goals.failed(id, replica, now)


class ResultDispatcher(PartDispatcher):
    """`get_result`: the first replica that succeeds; the others are told to cancel the goal."""

    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **others)
        self.shared.began = self._began

    def _began(self, goal: bytes, replica: int) -> None:
        """A replica has taken a goal, perhaps anew: it may be asked for the result."""
        with self._lock:
            self._requests.welcome(replica, partial(_is_about, goal))
        self._wake()

    def forward(self, request: bytes, payload: bytes, handle: Any, timeout_s: float) -> bool:
        """Take a request for a result; its goal is under way until that comes."""
        taken = super().forward(request, payload, handle, timeout_s)
        if taken:
            with self.shared.lock:
                self.shared.goals.awaited(goals.goal_of(payload))
        return taken

    def answered(self, link: Link, answer: Answer) -> None:
        """Take a result; where a replica does not know the goal, see why.

        It may be about to be given it, or has lost it: it is asked again. It may have refused it:
        it is not asked again. Or it has forgotten what became of it: then that is its result.
        """
        pending, payload = self._requests.get(answer.request_id), answer.payload
        if pending is None:
            super().answered(link, answer)
            return
        replica, goal = key_of(link), goals.goal_of(pending.item.payload)
        if payload is None:
            if answer.refusal is not None and Effect.GOALS_LOST in answer.refusal.effect:
                with self.shared.lock:
                    self.shared.goals.lost(goal, replica)
            super().answered(link, answer)
            return
        asked_at = pending.open.get(replica, -math.inf)
        with self.shared.lock:
            under_way = goal in self.shared.goals
            had = self.shared.goals.had(goal, replica, asked_at)
        if under_way and goals.is_unknown(payload) and had is not Had.TAKEN:
            reason = Refusal.FORGOTTEN if had is Had.REFUSED else Refusal.NOT_READY
            super().answered(link, answer._replace(payload=None, refusal=reason))
            return
        with self.shared.lock:
            losers = (self.shared.goals.takers(goal) | set(self._links)) - {replica}
        super().answered(link, answer)
        won = goals.is_success(Part.RESULT, payload) and answer.request_id not in self._requests
        if under_way and won:
            with self.shared.lock:
                self.shared.cancel(goal, losers, self._clock())
            self._wake()

    def _rejected(self, id: ReplicaId, replica: int, request: bytes, payload: bytes) -> None:
        """Keep the rejection that says more: that of a replica which knows the goal."""
        pending = self._requests.get(request)
        if pending is not None and pending.rejection is not None and goals.is_unknown(payload):
            payload = pending.rejection
        super()._rejected(id, replica, request, payload)

    def _is_over(self, goal: bytes) -> None:
        with self.shared.lock:
            self.shared.goals.ended(goal)


class Actions:
    """Makes the dispatchers of actions, and has those of one action share what they must."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._shared: dict[str, Shared] = {}

    def make(
        self, spec: ServiceSpec, respond: Callable[[Any, bytes], None], wake: Callable[[], None]
    ) -> PartDispatcher:
        """Make the dispatcher of an action's part."""
        action = spec.name.rpartition("/")[0]
        shared = self._shared.setdefault(action, Shared())
        if spec.part is Part.GOAL:
            return GoalDispatcher(spec, respond, shared, wake=wake, clock=self._clock)
        if spec.part is Part.RESULT:
            return ResultDispatcher(spec, respond, shared, wake=wake, clock=self._clock)
        return CancelDispatcher(spec, respond, shared, wake=wake, clock=self._clock)


def _is_about(goal: bytes, request: Request) -> bool:
    return goals.goal_of(request.payload) == goal
