"""`cancel_goal` on the robot: every replica is told until it has heard.

Owns: telling them. Not here: who is to be told, beside those whom a client tells (`action_part`).
"""

from __future__ import annotations

import os
from collections import OrderedDict
from typing import Any

from fogft.link.port import Answer, Link
from fogft.model.names import REQUEST_ID_BYTES
from fogft.model.spec import Part
from fogft.proxy.robot.action_part import CANCEL_FOR_S, CANCELS_KEPT, ReachingAll, ToCancel
from fogft.proxy.robot.dispatcher import key_of
from fogft.topics import goals

_TIMEOUT_S = 10.0
_AGAIN_S = 0.25


class CancelDispatcher(ReachingAll):
    """`cancel_goal`: every replica is told until it has heard, also one that is away meanwhile.

    What a replica cancels is begun on none that comes later.
    """

    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **others)
        self._sent: OrderedDict[bytes, tuple[bytes, float]] = OrderedDict()  # goal, until when

    def forward(self, request: bytes, payload: bytes, handle: Any, timeout_s: float) -> bool:
        """Take a client's cancellation."""
        goal = goals.goal_of(payload)
        if any(goal):  # else it means all goals made by now, and must not come later again
            self._note(request, goal, self._clock() + CANCEL_FOR_S)
        return super().forward(request, payload, handle, timeout_s)

    def _note(self, id: bytes, goal: bytes, until: float) -> None:
        with self.shared.lock:
            self._sent[id] = goal, until
            while len(self._sent) > CANCELS_KEPT:
                self._sent.popitem(last=False)

    def _declined(self, request: bytes, replica: int) -> None:
        self._not_heard(request, replica)
        super()._declined(request, replica)

    def answered(self, link: Link, answer: Answer) -> None:
        """Take the end of an attempt."""
        if answer.payload is None:
            self._not_heard(answer.request_id, key_of(link))
        elif goals.is_success(Part.CANCEL, answer.payload):
            with self.shared.lock:
                for goal in goals.cancelled(answer.payload):
                    self.shared.goals.cancelled(goal)
        super().answered(link, answer)

    def _not_heard(self, id: bytes, replica: int) -> None:
        now = self._clock()
        with self.shared.lock:
            goal, until = self._sent.get(id, (b"", 0.0))
            if now < until:
                again = ToCancel(goal, replica, now + _AGAIN_S, until)
                self.shared.to_cancel.append(again)

    def tick(self) -> float:
        """Also tell who works in vain, or was not there."""
        now = self._clock()
        with self.shared.lock:
            due = list(self.shared.to_cancel)
            self.shared.to_cancel.clear()
        later = [one for one in due if not self._tell(one, now) and now < one.until]
        with self.shared.lock:
            self.shared.to_cancel += later
        return super().tick()

    def _tell(self, one: ToCancel, now: float) -> bool:
        """Tell a replica; return whether its link has taken it."""
        link = self._links.get(one.replica)
        if now < one.at or link is None:
            return False
        id = os.urandom(REQUEST_ID_BYTES)
        self._note(id, one.goal, one.until)
        return link.offer(self.spec.name, id, goals.cancel_request(one.goal), _TIMEOUT_S)
