"""An action on the robot: three services whose requests go to all replicas.

Owns: judging the three services' answers; what replicas must still be sent. Not here: the table
of goals (`fogft.topics.goals`), feedback and status (`topics`). Design: docs/design/topics.md.
"""

import logging
import math
import os
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Collection, Iterable
from functools import partial
from typing import Any, NamedTuple

from fogft.model.names import REQUEST_ID_BYTES
from fogft.model.refusal import Effect, Refusal
from fogft.model.replica import short
from fogft.model.spec import Part, ServiceSpec
from fogft.proxy.robot.dispatcher import Dispatcher, Wake
from fogft.requests.decide import Decide, Judgement, Means, Pending, Reachable, Send
from fogft.topics import goals

log = logging.getLogger(__name__)

_CANCELS_KEPT = 4096
_CANCEL_FOR_S = 60.0  # a replica may be briefly unreachable
_CANCEL_TIMEOUT_S = 10.0
_CANCEL_AGAIN_S = 0.25
_SEVERAL = b""  # instead of a goal: the request cancels several


class _ToCancel(NamedTuple):
    """A cancellation of a goal to send to a replica: not before `at`, retried until `until`."""

    goal: bytes
    replica: int
    at: float
    until: float


class _Action:
    """State shared by the three services of one action, under a lock that is taken last."""

    def __init__(self, clock: Callable[[], float], wake: Callable[[], None]) -> None:
        self.lock = threading.Lock()
        self.clock = clock
        self.wake = wake
        self.goals = goals.Goals()
        self.to_cancel: deque[_ToCancel] = deque(maxlen=_CANCELS_KEPT)
        self.replicas: Collection[int] = ()
        # Called, without the lock, with a goal and a replica that has accepted it.
        self.began: Callable[[bytes, int], None] = lambda goal, replica: None

    def cancel(self, goal: bytes, replicas: Iterable[int], now: float) -> None:
        """Queue cancellations of a goal for replicas. Call under the lock."""
        until = now + _CANCEL_FOR_S
        self.to_cancel += [_ToCancel(goal, replica, now, until) for replica in replicas]
        self.wake()


class _CancelPart(Decide):
    """`cancel_goal`: sent to every replica, and retried where it is unreachable for a while."""

    replicates = True

    def __init__(self, action: _Action) -> None:
        super().__init__(partial(goals.is_success, Part.CANCEL))
        self._action = action
        self._replicas: Collection[int] = ()
        self._sent: OrderedDict[bytes, tuple[bytes, float]] = OrderedDict()  # goal, until when

    def began(self, request: bytes, pending: Pending, able: Collection[int]) -> None:
        if goals.names_one(pending.payload):
            goal, until = goals.goal_of(pending.payload), self._action.clock() + _CANCEL_FOR_S
            self._note(request, goal, until)
        else:  # it cancels all goals made so far, so it must not be sent again later
            self._note(request, _SEVERAL, -math.inf)

    def _note(self, id: bytes, goal: bytes, until: float) -> None:
        self._sent[id] = goal, until
        while len(self._sent) > _CANCELS_KEPT:
            self._sent.popitem(last=False)

    def judge(
        self, id: bytes, replica: int, payload: bytes, reading: Any, pending: Pending | None
    ) -> Judgement:
        """Note the goals that a replica has cancelled as told: it may also name other goals."""
        if reading:
            asked, _ = self._sent.get(id, (None, 0.0))
            with self._action.lock:
                for goal in goals.cancelled(payload):
                    if asked in (_SEVERAL, goal):
                        self._action.goals.cancelled(goal)
        return super().judge(id, replica, payload, reading, pending)

    def refused(
        self, id: bytes, replica: int, refusal: Refusal, detail: str, pending: Pending | None
    ) -> None:
        self.declined(id, replica, self._action.clock())

    def report(self) -> dict[str, Any]:
        return {"to_cancel": len(self._action.to_cancel)}

    def reach(self, replicas: Reachable, now: float) -> None:
        self._replicas = frozenset(replicas.versions)

    def take(self, now: float, timeout_s: float) -> list[Send]:
        """Return due cancellations, for replicas working in vain or unreachable earlier."""
        found, later = [], []
        with self._action.lock:
            for one in self._action.to_cancel:
                if one.at <= now and one.replica in self._replicas:
                    id, request = os.urandom(REQUEST_ID_BYTES), goals.cancel_request(one.goal)
                    self._note(id, one.goal, one.until)
                    found.append(Send(one.replica, id, request, _CANCEL_TIMEOUT_S))
                elif now < one.until:
                    later.append(one)
            self._action.to_cancel.clear()
            self._action.to_cancel += later
        return found

    def declined(self, id: bytes, replica: int, now: float) -> None:
        """Retry a cancellation that a replica did not receive."""
        with self._action.lock:
            goal, until = self._sent.get(id, (b"", 0.0))
            if now < until:
                self._action.to_cancel.append(
                    _ToCancel(goal, replica, now + _CANCEL_AGAIN_S, until)
                )


class _GoalPart(Decide):
    """`send_goal`: until a goal has its result, every replica that lacks the goal gets it."""

    replicates = True

    def __init__(self, action: _Action, name: str) -> None:
        super().__init__(partial(goals.is_success, Part.GOAL))
        self._action = action
        self._name = name

    def answer_to(self, request: bytes, payload: bytes) -> bytes | None:
        """Reject a goal with the id of another one, as action servers do."""
        with self._action.lock:
            id = self._action.goals.made_by(goals.goal_of(payload))
        return None if id in (None, request) else goals.REJECTED

    def began(self, request: bytes, pending: Pending, able: Collection[int]) -> None:
        with self._action.lock:
            self._action.goals.made(pending.payload, request, able, pending.deadline)

    def judge(
        self, id: bytes, replica: int, payload: bytes, reading: Any, pending: Pending | None
    ) -> Judgement:
        """Record which replica has the goal, before the client can ask for the result."""
        self._took(id, replica, accepts=reading)
        return super().judge(id, replica, payload, reading, pending)

    def _took(self, id: bytes, replica: int, *, accepts: bool) -> None:
        action, now = self._action, self._action.clock()
        with action.lock:
            goal, in_vain = action.goals.took(id, replica, now, accepts=accepts)
            if goal is not None and in_vain:
                action.cancel(goal, (replica,), now)
        if goal is not None and not in_vain:
            action.began(goal, replica)

    def refused(
        self, id: bytes, replica: int, refusal: Refusal, detail: str, pending: Pending | None
    ) -> None:
        if refusal is Refusal.MALFORMED:
            self._took(id, replica, accepts=False)
        else:
            self.declined(id, replica, self._action.clock())

    def closed(self, request: bytes, pending: Pending) -> None:
        """Drop a goal whose request has ended, unless a replica has accepted it."""
        goal = goals.goal_of(pending.payload)
        with self._action.lock:
            if goal not in self._action.goals:
                self._action.goals.ended(goal)

    def report(self) -> dict[str, Any]:
        return {"goals": self._action.goals.kept}

    def reach(self, replicas: Reachable, now: float) -> None:
        """Set the replicas to give goals to; new ones may have missed cancellations."""
        action = self._action
        with action.lock:
            for replica in set(action.replicas) - replicas.versions.keys():
                action.goals.left(replica)
            action.replicas = tuple(replicas.versions)
            for goal in action.goals.unwanted():
                action.cancel(goal, replicas.come, now)

    def take(self, now: float, timeout_s: float) -> list[Send]:
        found = []
        with self._action.lock:
            for replica in self._action.replicas:
                for payload in self._action.goals.lacking(replica, now):
                    id, goal = os.urandom(REQUEST_ID_BYTES), goals.goal_of(payload)
                    self._action.goals.gave(goal, id, replica, now + timeout_s)
                    found.append(Send(replica, id, payload, timeout_s))
                    log.info("goal_sent_again service=%s replica=%s goal=%s", self._name,
                             short(replica), goal.hex())  # fmt: skip
        return found

    def declined(self, id: bytes, replica: int, now: float) -> None:
        with self._action.lock:
            self._action.goals.failed(id, replica, now)

    def close(self) -> None:
        """Drop the action's goals: a different action may take its place."""
        with self._action.lock:
            self._action.goals.clear()


class _ResultPart(Decide):
    """`get_result`: the first replica that succeeds wins; the others must cancel the goal."""

    def __init__(self, action: _Action) -> None:
        super().__init__(partial(goals.is_success, Part.RESULT))
        self._action = action

    def began(self, request: bytes, pending: Pending, able: Collection[int]) -> None:
        with self._action.lock:
            self._action.goals.awaited(goals.goal_of(pending.payload))

    def judge(
        self, id: bytes, replica: int, payload: bytes, reading: Any, pending: Pending | None
    ) -> Judgement:
        if pending is None:
            return super().judge(id, replica, payload, reading, pending)
        action, goal = self._action, goals.goal_of(pending.payload)
        now, unknown = action.clock(), goals.is_unknown(payload)
        with action.lock:
            under_way = goal in action.goals
            lacked = action.goals.lacked(goal, replica, pending.open.get(replica, -math.inf))
            if under_way and unknown and lacked is not None:
                return lacked
            if reading and under_way and now < pending.deadline:
                losers = action.goals.takers(goal) | set(action.replicas)
                action.cancel(goal, losers - {replica}, now)
        if reading:
            return Means.SUCCESS
        weaker = unknown and pending.rejection is not None
        return Means.WEAKER_REJECTION if weaker else Means.REJECTION

    def refused(
        self, id: bytes, replica: int, refusal: Refusal, detail: str, pending: Pending | None
    ) -> None:
        if pending is not None and Effect.GOALS_LOST in refusal.effect:
            with self._action.lock:
                self._action.goals.lost(goals.goal_of(pending.payload), replica)

    def closed(self, request: bytes, pending: Pending) -> None:
        with self._action.lock:
            self._action.goals.ended(goals.goal_of(pending.payload))


class Actions:
    """Creates the dispatchers of actions; those of one action share state."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._actions: dict[str, _Action] = {}

    def make(
        self,
        spec: ServiceSpec,
        respond: Callable[[Any, bytes], None],
        wake: Wake,
        **how: Any,
    ) -> Dispatcher:
        """Create the dispatcher of an action's service; `how` as for `Dispatcher`."""
        name = spec.name.rpartition("/")[0]
        action = self._actions.setdefault(name, _Action(self._clock, wake))
        make = partial(Dispatcher, spec, respond, wake=wake, clock=self._clock, **how)
        if spec.part is Part.GOAL:
            return make(decide=_GoalPart(action, spec.name))
        if spec.part is Part.CANCEL:
            return make(decide=_CancelPart(action))
        result = make(decide=_ResultPart(action))
        action.began = lambda goal, replica: result.began_anew(
            replica, lambda request: goals.goal_of(request) == goal
        )
        return result
