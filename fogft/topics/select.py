"""Select which replicas' topic messages the robot gets. Pure: time is an argument.

Replicas run the same nodes on the same input, so most of their messages are redundant. Not here:
an action's status (`fogft.ros.messages`).
"""

from collections import OrderedDict

from fogft.model.topic import Select

# A leader may be replaced after a silence of twice its last gap, within these bounds. After its
# first message no gap is known, and the upper bound applies.
QUIET_S = 1.0
QUIET_LIMIT_S = 10.0
_KEPT = 1024  # stamps, and as many goals
_STAMP = slice(4, 12)  # of a message whose first field is a std_msgs/Header
_GOAL = slice(4, 20)  # of a feedback message: its goal's id


class Leader:
    """Passes the messages of one replica, or of another once that falls silent or leaves."""

    def __init__(self) -> None:
        self._leader: int | None = None
        self._last = 0.0
        self._quiet_s = QUIET_LIMIT_S

    def would_pass(self, replica: int, now: float) -> bool:
        """Whether a replica's message would go to the robot (`now`: monotonic seconds)."""
        return self._leader in (None, replica) or now - self._last > self._quiet_s

    def passes(self, replica: int, now: float) -> bool:
        """Take a replica's message; return whether it goes to the robot."""
        if not self.would_pass(replica, now):
            return False
        if replica != self._leader:
            self._leader, self._quiet_s = replica, QUIET_LIMIT_S
        else:
            self._quiet_s = min(max(QUIET_S, 2 * (now - self._last)), QUIET_LIMIT_S)
        self._last = now
        return True

    def left(self, replica: int) -> None:
        """Note that a replica is gone: the next replica to publish becomes the leader."""
        if replica == self._leader:
            self._leader = None


class Selection:
    """The selection of one topic's messages."""

    def __init__(self, select: Select) -> None:
        self._select = select
        self._leader = Leader()
        # How often each replica sent each stamp, and when one passed last. A repeated one is of a
        # new message: one of several at once, or a simulation's clock was set back or stands still.
        self._stamps: OrderedDict[bytes, tuple[dict[int, int], float]] = OrderedDict()
        self._goals: OrderedDict[bytes, Leader] = OrderedDict()

    def passes(self, replica: int, message: bytes, now: float) -> bool:
        """Whether the robot gets a replica's message (CDR) (`now`: monotonic seconds)."""
        if self._select is Select.STAMP:
            return self._first_of_its_stamp(replica, message, now)
        if self._select is Select.GOAL:
            return self._of_goal(message[_GOAL]).passes(replica, now)
        return self._select is not Select.LEADER or self._leader.passes(replica, now)

    def wants(self, replica: int, now: float) -> bool:
        """Whether to pull messages from a replica: not if all of them would be dropped."""
        return self._select is not Select.LEADER or self._leader.would_pass(replica, now)

    def _first_of_its_stamp(self, replica: int, message: bytes, now: float) -> bool:
        stamp = message[:2] + message[_STAMP]
        if not any(message[_STAMP]):  # not set: it identifies nothing
            return self._leader.passes(replica, now)
        counts, passed_at = self._stamps.get(stamp, ({}, now))
        if replica in counts and now - passed_at > QUIET_S:
            counts = {}
        most = max(counts.values(), default=0)
        counts[replica] = counts.get(replica, 0) + 1
        if counts[replica] <= most:
            return False
        self._stamps[stamp] = counts, now
        if len(self._stamps) > _KEPT:
            self._stamps.popitem(last=False)
        return True

    def _of_goal(self, goal: bytes) -> Leader:
        leader = self._goals.get(goal)
        if leader is None:
            leader = self._goals[goal] = Leader()
            if len(self._goals) > _KEPT:
                self._goals.popitem(last=False)
        return leader

    def left(self, replica: int) -> None:
        """Note that a replica is gone."""
        self._leader.left(replica)
        for leader in self._goals.values():
            leader.left(replica)
