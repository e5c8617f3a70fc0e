"""An action's goals: each made by its client, and worked on by every replica. Pure.

Everything about a goal is known by the id that its client gave it, the first 16 bytes of a
request (CDR, after its header).

Owns: what the parts' bytes mean, which goals are under way, one status out of several.
Not here: sending (`fogft.proxy.actions`), reading whole messages (`fogft.ros.goal_status`).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping

from fogft.core.spec import Part

_ID = slice(4, 20)
_SUCCEEDED = 4
_UNKNOWN = 0
_CDR_HEADER = b"\x00\x01\x00\x00"
_NO_TIME = bytes(8)
_GOALS_KEPT = 4096
# Which of two statuses says more: done well, then the furthest of those under way, then an end.
_RANK = {4: 9, 3: 8, 2: 7, 1: 6, 5: 5, 6: 4, 0: 0}


def goal_of(request: bytes) -> bytes:
    """Return the goal's id of a request of any part."""
    return request[_ID]


def is_success(part: Part, response: bytes) -> bool:
    """Whether a response ends its request: accepted, succeeded, or something is cancelled."""
    if part is Part.RESULT:
        return response[4:5] == bytes([_SUCCEEDED])
    if part is Part.CANCEL:  # a return code, padding, and a list of goals
        return response[4:5] == b"\0" and any(response[8:12])
    return response[4:5] == b"\1"


def is_unknown(response: bytes) -> bool:
    """Whether a result says that its replica does not know the goal."""
    return response[4:5] == bytes([_UNKNOWN])


def cancel_request(goal: bytes) -> bytes:
    """Return a request (CDR) that cancels one goal."""
    return _CDR_HEADER + goal + _NO_TIME


class Goals:
    """Goals that were accepted and have no result yet, with their requests."""

    def __init__(self) -> None:
        self._open: OrderedDict[bytes, bytes] = OrderedDict()
        self._awaited: set[bytes] = set()

    def accepted(self, request: bytes) -> None:
        """A replica has accepted a goal."""
        self._open[goal_of(request)] = request
        if len(self._open) > _GOALS_KEPT:
            self.ended(next(iter(self._open)))

    def awaited(self, goal: bytes) -> None:
        """Its client awaits the result."""
        if goal in self._open:
            self._awaited.add(goal)

    def ended(self, goal: bytes) -> None:
        """A goal has its result, or its client has given up. Unknown goals are fine."""
        self._open.pop(goal, None)
        self._awaited.discard(goal)

    def __contains__(self, goal: bytes) -> bool:
        return goal in self._open

    @property
    def requests(self) -> tuple[bytes, ...]:
        """The requests of the goals whose results are awaited, oldest first."""
        return tuple(r for goal, r in self._open.items() if goal in self._awaited)


def merged(said: Mapping[int, Mapping[bytes, int]]) -> dict[bytes, int]:
    """Return one status for each goal of what replicas say (replica -> goal -> status)."""
    found: dict[bytes, int] = {}
    for statuses in said.values():
        for goal, status in statuses.items():
            if goal not in found or _RANK.get(status, 0) > _RANK.get(found[goal], 0):
                found[goal] = status
    return found
