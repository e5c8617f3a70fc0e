"""The queue at a replica: by deadline within a robot, fair between robots. Pure.

The robot served least is next. A robot that returns after a pause starts level with the others
(start-time fair queueing): it can neither save up turns nor lose them.

Laws: each item put in comes out once, or is removed; a robot with items waiting is served
at least every n-th time, with n robots waiting; of two requests of one robot the earlier
deadline goes first.

Not here: how many may wait or run at once (`concurrency`, `proxy.replica.responder`).
"""

import heapq
from dataclasses import dataclass
from itertools import count
from typing import Generic, TypeVar

T = TypeVar("T")


@dataclass(eq=False)
class _Entry(Generic[T]):
    id: bytes
    robot: str
    item: T | None


_Ranked = tuple[float, int, _Entry[T]]  # no two have the same number


class _Robot(Generic[T]):
    def __init__(self, given: float) -> None:
        self.heap: list[_Ranked[T]] = []  # removed entries stay until they reach the top
        self.waiting = 0
        self.given = given

    def standing(self) -> tuple[float, _Ranked[T]]:
        """Return its sort key: the robot served least is next, then the earliest deadline."""
        while self.heap[0][2].item is None:
            heapq.heappop(self.heap)
        return self.given, self.heap[0]


class FairQueue(Generic[T]):
    """The queue of one service at a replica, by request id.

    With `latest`, a robot's newest request is served first and its oldest is evicted first: as a
    service has one time-out, the latest deadline is the newest request's.
    """

    def __init__(self, *, latest: bool = False) -> None:
        self._sign = -1.0 if latest else 1.0
        self._robots: dict[str, _Robot[T]] = {}  # robots with items waiting
        self._entries: dict[bytes, _Entry[T]] = {}
        self.size = self._entries.__len__
        self._order = count()
        self._turn = 0.0  # virtual time: `given` of the robot served last, before that turn

    def put(self, id: bytes, robot: str, deadline: float, item: T) -> None:
        """Queue an item. Its id must not be queued already."""
        entry = _Entry(id, robot, item)
        queue = self._robots.get(robot)
        if queue is None:
            queue = self._robots[robot] = _Robot(self._turn)
        heapq.heappush(queue.heap, (self._sign * deadline, next(self._order), entry))
        queue.waiting += 1
        self._entries[id] = entry

    def take(self) -> T | None:
        """Remove and return the next item; None if empty."""
        if not self._robots:
            return None
        self._turn, (_, _, entry) = min([queue.standing() for queue in self._robots.values()])
        self._robots[entry.robot].given += 1.0
        return self._remove(entry)

    def not_served(self, robot: str) -> None:
        """Give a robot its turn back: the item taken was not served."""
        if robot in self._robots:
            self._robots[robot].given -= 1.0

    def remove(self, id: bytes) -> T | None:
        """Remove and return an item; None if it is not queued."""
        entry = self._entries.get(id)
        return None if entry is None else self._remove(entry)

    def _remove(self, entry: _Entry[T]) -> T | None:
        del self._entries[entry.id]
        item, entry.item = entry.item, None
        queue = self._robots[entry.robot]
        queue.waiting -= 1
        if not queue.waiting:
            del self._robots[entry.robot]
        elif len(queue.heap) > 2 * queue.waiting + 16:
            queue.heap = [kept for kept in queue.heap if kept[2].item is not None]
            heapq.heapify(queue.heap)
        return item

    def evict(self, robot: str, deadline: float) -> T | None:
        """Remove and return the item evicted for a new one; None if the new one must go."""
        most = max(self._robots.values(), key=lambda queue: queue.waiting, default=None)
        own = self._robots.get(robot)
        if most is None:
            return None
        if own is not None and own.waiting >= most.waiting:
            most = own
        elif most.waiting <= (own.waiting if own is not None else 0) + 1:
            return None  # equal shares: no robot has too much
        rank, _, last = max(ranked for ranked in most.heap if ranked[2].item is not None)
        if most is own and rank <= self._sign * deadline:
            return None
        return self._remove(last)

    def ahead(self, robot: str, deadline: float) -> int:
        """Return roughly how many items will be served before a request that arrives now."""
        own = self._robots.get(robot)
        before, rank = 0, self._sign * deadline
        if own is not None:
            before = sum(1 for at, _, e in own.heap if e.item is not None and at <= rank)
        others = (queue.waiting for name, queue in self._robots.items() if name != robot)
        return before + sum(min(waiting, before + 1) for waiting in others)
