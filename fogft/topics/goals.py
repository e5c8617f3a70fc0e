"""An action's goals: each sent by a client and executed by every replica. Pure.

A goal is identified by the id that its client gave it, the first 16 bytes of a request (CDR, after
its header).

Not here: sending (`fogft.proxy.robot.actions`), whole messages (`fogft.ros.messages`).
"""

import math
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from fogft.model.refusal import Refusal
from fogft.model.spec import Part

_ID = slice(4, 20)
_SUCCEEDED = 4
_UNKNOWN = 0
_CDR_HEADER = b"\x00\x01\x00\x00"
_NO_TIME = bytes(8)
REJECTED = _CDR_HEADER + bytes(12)  # the response to a goal: not accepted, at no time
RESULT_OF_NONE = _CDR_HEADER + bytes(16)  # a result request that is answered at once
GOALS_KEPT = 4096
BYTES_KEPT = 64 << 20
_AGAIN_AFTER_S = 0.25  # the first retry delay; it doubles each time
_AGAIN_LIMIT_S = 8.0
# Which status prevails: succeeded, then the most advanced one in progress, then another end.
_RANK = {4: 9, 3: 8, 2: 7, 1: 6, 5: 5, 6: 4, 0: 0}


def goal_of(request: bytes) -> bytes:
    """Return the goal id in a request to any of an action's services."""
    return request[_ID]


def is_success(part: Part, response: bytes) -> bool:
    """Whether a response completes its request: accepted, succeeded or cancelled."""
    if part is Part.RESULT:
        return response[4:5] == bytes([_SUCCEEDED])
    if part is Part.CANCEL:  # a return code, padding, and a list of goals
        return response[4:5] == b"\0" and any(response[8:12])
    return response[4:5] == b"\1"


def is_unknown(response: bytes) -> bool:
    """Whether a result response says that its replica does not know the goal."""
    return response[4:5] == bytes([_UNKNOWN])


def cancelled(response: bytes) -> list[bytes]:
    """Return the goals in a response to a cancel request; a truncated one has fewer."""
    order = "little" if response[1:2] == b"\1" else "big"
    count = int.from_bytes(response[8:12], order)  # type: ignore[arg-type]
    found = [response[at : at + 16] for at in range(12, len(response), 24)]
    return [goal for goal in found[:count] if len(goal) == 16]


def cancel_request(goal: bytes) -> bytes:
    """Return a request (CDR) that cancels one goal."""
    return _CDR_HEADER + goal + _NO_TIME


def names_one(cancel: bytes) -> bool:
    """Whether a cancel request means one goal, rather than all, or all up to a time."""
    return any(goal_of(cancel)) and not any(cancel[20:28])


@dataclass(frozen=True)
class _Word:
    """A replica's last response to a goal. Times in seconds on the caller's clock."""

    until: float  # when to resend it the goal, if it does not respond before
    since: float = math.inf  # when it accepted it (-inf: refused); a later "unknown" counts
    again_s: float = 0.0  # the last retry delay, after the goal did not reach it


@dataclass
class _Goal:
    id: bytes  # of its client's request
    request: bytes
    cancelled: bool = False
    takers: set[int] = field(default_factory=set)  # replicas that ever accepted it
    words: dict[int, _Word] = field(default_factory=dict)  # by replica
    ids: set[bytes] = field(default_factory=set)  # of all requests that sent it to a replica


class Goals:
    """The goals of one action, from their request to their result.

    Beyond 4 096 goals or 64 MiB of requests the oldest are forgotten, those that nobody awaits
    first.
    """

    def __init__(self) -> None:
        self._goals: OrderedDict[bytes, _Goal] = OrderedDict()
        self._of_id: dict[bytes, bytes] = {}  # request id -> goal
        self._awaited: dict[bytes, _Goal] = {}
        self.over: OrderedDict[bytes, bytes] = OrderedDict()  # the same, for goals that ended
        self._past: OrderedDict[bytes, bytes] = OrderedDict()  # goal that ended -> its `id`
        self._bytes = 0

    # -- sending --------------------------------------------------------------------------

    def made(self, request: bytes, id: bytes, replicas: Iterable[int], until: float) -> None:
        """Note a new goal: its request goes to these replicas, under one id."""
        goal = goal_of(request)
        if goal not in self._goals:
            self._goals[goal] = _Goal(id, request)
            self._bytes += len(request)
        self._goals.move_to_end(goal)
        self._note(goal, id)
        for replica in replicas:
            self.gave(goal, id, replica, until)
        while len(self._goals) > 1 and (len(self._goals) > GOALS_KEPT or self._bytes > BYTES_KEPT):
            oldest = next(iter(self._goals))
            unwanted = (one for one in self._goals if one != goal and one not in self._awaited)
            self._drop(next(unwanted, oldest))

    def gave(self, goal: bytes, id: bytes, replica: int, until: float) -> None:
        """Note that a replica is sent a goal; it is resent at `until` if there is no answer."""
        known = self._goals.get(goal)
        if known is not None:
            word = known.words.get(replica)
            known.words[replica] = _Word(until, again_s=0.0 if word is None else word.again_s)
            self._note(goal, id)

    def _note(self, goal: bytes, id: bytes) -> None:
        self._goals[goal].ids.add(id)
        self._of_id[id] = goal

    def took(
        self, id: bytes, replica: int, now: float, *, accepts: bool
    ) -> tuple[bytes | None, bool]:
        """Note whether a replica accepts a goal. Unknown ids are ignored.

        Returns the goal, or None if the replica did not accept it, had it before, or it is no
        longer known; and whether the goal is over or cancelled.
        """
        known = self._given_by(id)
        if known is None:
            goal = self.over.get(id) if accepts else None
            return goal, True
        if accepts:
            known.takers.add(replica)
        word = known.words.get(replica)
        if word is not None and math.isfinite(word.since):  # it has accepted it before
            return None, False
        known.words[replica] = _Word(math.inf, now if accepts else -math.inf)
        return goal_of(known.request) if accepts else None, known.cancelled

    def failed(self, id: bytes, replica: int, now: float) -> None:
        """Note that a goal did not reach a replica: it is resent soon."""
        known = self._given_by(id)
        if known is None:
            return
        word = known.words.get(replica)
        if word is None or word.since == math.inf:
            waited_s = 0.0 if word is None else word.again_s
            again_s = min(2 * waited_s or _AGAIN_AFTER_S, _AGAIN_LIMIT_S)
            known.words[replica] = _Word(now + again_s, again_s=again_s)
        if id != known.id:
            known.ids.discard(id)
            del self._of_id[id]

    def _given_by(self, id: bytes) -> _Goal | None:
        return self._goals.get(self._of_id.get(id, b""))

    def lost(self, goal: bytes, replica: int) -> None:
        """Note that a replica may have lost a goal: it is resent."""
        known = self._goals.get(goal)
        if known is not None:
            known.words.pop(replica, None)

    def left(self, replica: int) -> None:
        """Note that a replica is gone; its successor may know none of the goals."""
        for known in self._goals.values():
            known.words.pop(replica, None)

    def lacking(self, replica: int, now: float) -> list[bytes]:
        """Return the goal requests to send to a replica, oldest first."""
        return [
            known.request
            for known in self._awaited.values()
            if replica not in known.words or known.words[replica].until <= now
        ]

    # -- results --------------------------------------------------------------------------

    def awaited(self, goal: bytes) -> None:
        """Note that a client awaits the result of a running goal."""
        if goal in self and not self._goals[goal].cancelled:
            self._awaited[goal] = self._goals[goal]

    def cancelled(self, goal: bytes) -> None:
        """Note a cancelled goal: it is no longer sent. Unknown goals are ignored."""
        known = self._goals.get(goal)
        if known is not None:
            known.cancelled = True
            self._awaited.pop(goal, None)

    def ended(self, goal: bytes) -> None:
        """Note that a goal has ended, or its client gave up. Unknown goals are ignored."""
        known = self._drop(goal)
        if known is not None and known.takers:
            self._past[goal] = known.id
            if len(self._past) > GOALS_KEPT:
                self._past.popitem(last=False)
        if known is not None and any(word.since == math.inf for word in known.words.values()):
            self.over.update(dict.fromkeys(known.ids, goal))
            while len(self.over) > GOALS_KEPT:
                self.over.popitem(last=False)

    def _drop(self, goal: bytes) -> _Goal | None:
        """Forget a goal, which may still be running."""
        self._awaited.pop(goal, None)
        known = self._goals.pop(goal, None)
        if known is not None:
            self._bytes -= len(known.request)
            for id in known.ids:
                del self._of_id[id]
        return known

    def takers(self, goal: bytes) -> frozenset[int]:
        """Return the replicas that accepted a goal, including those that are gone."""
        known = self._goals.get(goal)
        return frozenset() if known is None else frozenset(known.takers)

    def unwanted(self) -> list[bytes]:
        """Return the cancelled goals that still run."""
        return [goal for goal, known in self._goals.items() if known.takers and known.cancelled]

    def clear(self) -> None:
        """Forget all goals."""
        for goal in list(self._goals):
            self.ended(goal)

    @property
    def kept(self) -> int:
        """The number of remembered goals."""
        return len(self._goals)

    def __contains__(self, goal: bytes) -> bool:
        """Whether a goal is under way: accepted, and without a result."""
        known = self._goals.get(goal)
        return known is not None and bool(known.takers)

    def made_by(self, goal: bytes) -> bytes | None:
        """Return the id of the request that made an accepted goal; None for any other."""
        return self._goals[goal].id if goal in self else self._past.get(goal)

    def lacked(self, goal: bytes, replica: int, asked_at: float) -> Refusal | None:
        """Return why a replica asked for the result does not know the goal; None if it had it.

        It refused the goal (`FORGOTTEN`), or has not responded to it yet (`NOT_READY`).
        """
        known = self._goals.get(goal)
        word = None if known is None else known.words.get(replica)
        if known is not None and known.cancelled:
            return None  # the goal need not be sent to it any more
        if word is None or asked_at < word.since:
            return Refusal.NOT_READY
        return None if math.isfinite(word.since) else Refusal.FORGOTTEN


def merged(said: Mapping[int, Mapping[bytes, int]]) -> dict[bytes, int]:
    """Merge statuses (replica -> goal -> status) into one for each goal."""
    found: dict[bytes, int] = {}
    for statuses in said.values():
        for goal, status in statuses.items():
            if goal not in found or _RANK.get(status, 0) > _RANK.get(found[goal], 0):
                found[goal] = status
    return found
