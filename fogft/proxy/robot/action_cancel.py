"""`cancel_goal` on the robot: every replica is told until it has heard.

Owns: what an action's three services share, and telling replicas to cancel. Not here: goals and
results (`actions`), what the bytes mean (`fogft.topics.goals`).
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from fogft.model.names import REQUEST_ID_BYTES
from fogft.model.refusal import Refusal
from fogft.model.spec import Part
from fogft.requests.decide import Decide, Judgement, Send
from fogft.requests.first_response import Pending
from fogft.topics import goals
from fogft.topics.goals import Goals

_CANCELS_KEPT = 4096
_CANCEL_FOR_S = 60.0  # a replica may be away for a moment
_CANCEL_TIMEOUT_S = 10.0
_CANCEL_AGAIN_S = 0.25


@dataclass(frozen=True)
class _ToCancel:
    """That a replica is to be told to cancel a goal: from when, and until when it is tried."""

    goal: bytes
    replica: int
    at: float
    until: float


class Action:
    """What the three services of one action share, under a lock that is taken last.

    Attributes:
        began: Called, without the lock, with a goal and a replica that has taken it.
    """

    def __init__(self, clock: Callable[[], float], wake: Callable[[], None]) -> None:
        self.lock = threading.Lock()
        self.clock = clock
        self.wake = wake
        self.goals = Goals()
        self.to_cancel: deque[_ToCancel] = deque(maxlen=_CANCELS_KEPT)
        self.replicas: Collection[int] = ()
        self.began: Callable[[bytes, int], None] = lambda goal, replica: None

    def cancel(self, goal: bytes, replicas: Iterable[int], now: float) -> None:
        """Have replicas told to cancel a goal. Under the lock."""
        until = now + _CANCEL_FOR_S
        self.to_cancel += [_ToCancel(goal, replica, now, until) for replica in replicas]
        self.wake()


class CancelPart(Decide):
    """`cancel_goal`: every replica is told until it has heard, also one that is away meanwhile.

    What a replica cancels is begun on none that comes later.
    """

    replicates = True

    def __init__(self, action: Action) -> None:
        super().__init__(partial(goals.is_success, Part.CANCEL))
        self._action = action
        self._replicas: Collection[int] = ()
        self._sent: OrderedDict[bytes, tuple[bytes, float]] = OrderedDict()  # goal, until when

    def began(self, request: bytes, pending: Pending[Any], able: Collection[int]) -> None:
        """Note a client's cancellation."""
        goal = goals.goal_of(pending.item.payload)
        if any(goal):  # else it means all goals made by now, and must not come later again
            self._note(request, goal, self._action.clock() + _CANCEL_FOR_S)

    def _note(self, id: bytes, goal: bytes, until: float) -> None:
        self._sent[id] = goal, until
        while len(self._sent) > _CANCELS_KEPT:
            self._sent.popitem(last=False)

    def judge(
        self, id: bytes, replica: int, payload: bytes, reading: Any, pending: Pending[Any] | None
    ) -> Judgement:
        """Note what a replica has cancelled."""
        if reading:
            with self._action.lock:
                for goal in goals.cancelled(payload):
                    self._action.goals.cancelled(goal)
        return super().judge(id, replica, payload, reading, pending)

    def refused(
        self, id: bytes, replica: int, refusal: Refusal, detail: str, pending: Pending[Any] | None
    ) -> None:
        """A replica has not heard it."""
        self.declined(id, replica, self._action.clock())

    def hears_out(self, request: bytes) -> bool:
        """All replicas shall be told, whoever was first."""
        return True

    def report(self) -> dict[str, Any]:
        """Return how many replicas are still to be told."""
        return {"to_cancel": len(self._action.to_cancel)}

    # -- what replicas must have ----------------------------------------------------------

    def reach(
        self,
        come: Collection[int],
        now: float,
        versions: Mapping[int, str],
        leaving: Collection[int],
    ) -> None:
        """Note who can be told."""
        self._replicas = frozenset(versions)

    def take(self, now: float, timeout_s: float) -> list[Send]:
        """Return what is to be told to those who work in vain, or were not there."""
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
        """A replica has not heard it: it is told again."""
        with self._action.lock:
            goal, until = self._sent.get(id, (b"", 0.0))
            if now < until:
                self._action.to_cancel.append(
                    _ToCancel(goal, replica, now + _CANCEL_AGAIN_S, until)
                )
