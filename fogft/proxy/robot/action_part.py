"""What the three services of an action on the robot have in common.

Owns: the action's goals, and who is to be told to cancel. Not here: the services (`actions`,
`action_cancel`).
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from fogft.model.spec import ServiceSpec
from fogft.proxy.robot.dispatcher import Dispatcher
from fogft.proxy.robot.request import Request
from fogft.requests.first_response import Pending
from fogft.topics import goals
from fogft.topics.goals import Goals

CANCELS_KEPT = 4096
CANCEL_FOR_S = 60.0  # a replica may be away for a moment


@dataclass(frozen=True)
class ToCancel:
    """That a replica is to be told to cancel a goal: from when, and until when it is tried."""

    goal: bytes
    replica: int
    at: float
    until: float


class Shared:
    """What the three services of one action share, under a lock that is taken last.

    Attributes:
        goals: Its goals.
        to_cancel: Who is to be told.
        began: Called, without the lock, with a goal and a replica that has taken it.
    """

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.goals = Goals()
        self.to_cancel: deque[ToCancel] = deque(maxlen=CANCELS_KEPT)
        self.began: Callable[[bytes, int], None] = lambda goal, replica: None

    def cancel(self, goal: bytes, replicas: Iterable[int], now: float) -> None:
        """Have replicas told to cancel a goal. Under the lock."""
        until = now + CANCEL_FOR_S
        self.to_cancel += [ToCancel(goal, replica, now, until) for replica in replicas]


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
        self.shared = shared
        self._part = spec.part
        super().__init__(spec, respond, **others)

    def _check(self, ok_field: str) -> Callable[[bytes], bool]:
        return lambda response: goals.is_success(self._part, response)

    def _close(self, request: bytes, pending: Pending[Request]) -> None:
        super()._close(request, pending)
        self._is_over(goals.goal_of(pending.item.payload))

    def _expired(self, request: bytes, pending: Pending[Request]) -> None:
        super()._expired(request, pending)
        self._is_over(goals.goal_of(pending.item.payload))

    def _is_over(self, goal: bytes) -> None:
        """A request about a goal has its response, or will have none."""

    def close(self) -> None:
        """End the action's goals: what comes in its place may be another action."""
        with self.shared.lock:
            self.shared.goals.clear()


class ReachingAll(PartDispatcher):
    """Every replica gets each request, whoever was first."""

    def _forget(self, request: bytes, replicas: Iterable[int]) -> None:
        """Let the others go on: they shall all have it."""
