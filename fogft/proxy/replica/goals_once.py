"""Ensure that a replica's action server gets each goal once, however often it is sent.

Receiving a goal twice harms some action servers: rclcpp's ends its process. So copies of a goal
wait for the answer to the first, and copies of an accepted goal get the same answer.

Owns: `send_goal` requests, from the link to the answer, and which goals the current action server
has. Not here: the action's other services (`responder`).
"""

import logging
import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial

from fogft.byte_limit import ByteLimit
from fogft.errors import RosError, Unreadable
from fogft.link.port import Incoming
from fogft.model.refusal import Refusal
from fogft.model.spec import Part
from fogft.proxy.replica.responder import OUTSTANDING
from fogft.ros.port import RosClient
from fogft.topics import goals

log = logging.getLogger(__name__)

_QUEUE_LIMIT = 512
_COPIES_LIMIT = 64
_BYTES_LIMIT = 64 << 20  # total size of unanswered goals
# A goal not answered for this long no longer counts against the limit of outstanding goals.
_PATIENCE_S = 60.0
# When an action server dies, its services disappear one after the other, within this time.
_ONE_DEATH_S = 1.0


class _Open:
    """A goal that has no answer yet."""

    def __init__(self, goal: bytes, robot: str, payload: bytes) -> None:
        self.goal, self.robot, self.payload = goal, robot, payload
        self.size = len(payload)
        self.begun_at: float | None = None  # when it was passed to the action server
        self.unheard = False  # its answer can no longer reach us
        self.ticket: int | None = None
        self.waiting: list[tuple[float, Incoming]] = []  # copies, each with its deadline

    def holds(self, now: float) -> bool:
        """Whether it counts against the limit of outstanding goals."""
        begun_at = self.begun_at
        return begun_at is not None and not self.unheard and now - begun_at <= _PATIENCE_S


class _ActionServer:
    """What is known about one `send_goal` service since its last start."""

    def __init__(self) -> None:
        self.death = "", -math.inf  # the service whose loss was noted last, and when
        self.open: dict[bytes, _Open] = {}  # oldest first
        self.served: dict[str, float] = {}  # when each robot's latest goal was passed on
        self.accepted: OrderedDict[bytes, bytes] = OrderedDict()

    @property
    def queue(self) -> list[_Open]:
        return [known for known in self.open.values() if known.begun_at is None]

    def next(self) -> _Open | None:
        """Return the oldest queued goal of the robot that was served least recently."""
        return min(
            self.queue, key=lambda known: self.served.get(known.robot, -math.inf), default=None
        )

    def at_work(self, now: float) -> int:
        return sum(known.holds(now) for known in self.open.values())


@dataclass(eq=False)
class GoalsOnce:
    """Forwards new goals; remembers the last `accepted_kept` of each action."""

    outstanding = OUTSTANDING  # limit on unanswered goals at an action server
    accepted_kept = 16_384  # per action, 200 bytes each; the oldest are forgotten first

    services: Collection[str]
    is_ready: Callable[[str], bool]
    clock: Callable[[], float]

    def __post_init__(self) -> None:
        self._servers = {service: _ActionServer() for service in self.services}
        self._lock = threading.Lock()
        self._clients: Mapping[str, RosClient] = {}

    def __contains__(self, service: object) -> bool:
        return service in self._servers

    def __bool__(self) -> bool:
        return bool(self._servers)

    @property
    def in_flight(self) -> int:
        """The number of goals without an answer yet."""
        with self._lock:
            return sum(len(server.open) for server in self._servers.values())

    def use(self, clients: Mapping[str, RosClient]) -> None:
        """Set the clients of the local services."""
        self._clients = clients

    # -- from the link --------------------------------------------------------------------

    def request(self, incoming: Incoming) -> None:
        """Take a goal from the link. Never blocks."""
        service, goal = incoming.service, goals.goal_of(incoming.payload)
        server = self._servers[service]
        with self._lock:
            answer = server.accepted.get(goal)
            reason = None if answer is not None else self._reason_to_refuse(server, incoming, goal)
            if answer is None and reason is None:
                known = server.open.get(goal)
                if known is None:
                    known = server.open[goal] = _Open(goal, incoming.robot, incoming.payload)
                known.waiting.append((self.clock() + incoming.remaining_s, incoming))
        if answer is not None:
            incoming.reply(answer)
        elif reason is not None:
            incoming.refuse(reason)
        else:
            self._pass_on(service)

    def _reason_to_refuse(
        self, server: _ActionServer, incoming: Incoming, goal: bytes
    ) -> Refusal | None:
        if incoming.remaining_s <= 0:
            return Refusal.EXPIRED
        if not self.is_ready(incoming.service) or incoming.service not in self._clients:
            return Refusal.NOT_READY
        large = ByteLimit(_BYTES_LIMIT)
        for other in self._servers.values():
            for open in other.open.values():
                large.add(open.size * max(len(open.waiting), 1), open.robot)
        if not large.has_room(len(incoming.payload), incoming.robot):
            return Refusal.OVERLOADED
        known = server.open.get(goal)
        if known is None:
            own = sum(open.robot == incoming.robot for open in server.queue)
            return Refusal.OVERLOADED if own >= _QUEUE_LIMIT else None
        return Refusal.OVERLOADED if len(known.waiting) >= _COPIES_LIMIT else None

    # -- to the action server -------------------------------------------------------------

    def _pass_on(self, service: str) -> None:
        """Pass queued goals to an action server, up to its limit."""
        server = self._servers[service]
        while True:
            with self._lock:
                now, known = self.clock(), server.next()
                if known is None or server.at_work(now) >= self.outstanding:
                    return
                known.begun_at = server.served[known.robot] = now
                payload, known.payload = known.payload, b""
                client = self._clients.get(service)  # the current one; a crash replaces it
            if client is None:
                self._drop(service, known, Refusal.NOT_READY)
                continue
            try:
                known.ticket = client.call(payload, partial(self._answered, service, known))
            except RosError as error:
                log.warning("goal_not_passed_on service=%s reason=%r", service, str(error))
                hopeless = isinstance(error, Unreadable)
                reason = Refusal.MALFORMED if hopeless else Refusal.OVERLOADED
                self._drop(service, known, reason)

    def _drop(self, service: str, known: _Open, reason: Refusal) -> None:
        """Refuse a goal that could not be passed to the action server."""
        with self._lock:
            if self._servers[service].open.get(known.goal) is known:
                del self._servers[service].open[known.goal]
        self._refuse(service, (known,), reason)

    def _answered(self, service: str, known: _Open, answer: bytes) -> None:
        server = self._servers[service]
        with self._lock:
            if server.open.get(known.goal) is not known:  # the action server has died since
                return
            del server.open[known.goal]
            lost = self._overtaken(server, known)
            if goals.is_success(Part.GOAL, answer):
                server.accepted[known.goal] = answer
                if len(server.accepted) > self.accepted_kept:
                    server.accepted.popitem(last=False)
        try:
            for _, incoming in known.waiting:
                incoming.reply(answer)
        finally:
            self._refuse(service, lost, Refusal.LOST)
            self._pass_on(service)

    def _overtaken(self, server: _ActionServer, by: _Open) -> list[_Open]:
        """Remove goals that an action server will never answer. Call under the lock.

        After a long silence it may have got more goals than its queue holds, which drops the
        oldest. It answers in order, so it has lost unanswered goals older than `by`.
        """
        now, by_at = self.clock(), by.begun_at or 0.0
        lost = [
            goal
            for goal, known in server.open.items()
            if known.begun_at is not None
            and known.begun_at < by_at
            and not known.unheard
            and not known.holds(now)
        ]
        return [server.open.pop(goal) for goal in lost]

    def tick(self) -> None:
        """Refuse copies past their deadline. Call at about 10 Hz."""
        now = self.clock()
        late: list[Incoming] = []
        with self._lock:
            for server in self._servers.values():
                for goal, known in list(server.open.items()):
                    late += [one for deadline, one in known.waiting if deadline <= now]
                    known.waiting = [entry for entry in known.waiting if entry[0] > now]
                    if known.begun_at is None and not known.waiting:
                        del server.open[goal]  # never begun, and no caller waits for it
        for incoming in late:
            incoming.refuse(Refusal.EXPIRED)
        for service in self._servers:
            self._pass_on(service)

    def crashed(self, service: str = "") -> None:
        """Note that a service, or the whole command, died: its action has lost all goals."""
        action, now = service.rpartition("/")[0], self.clock()
        for name, server in self._servers.items():
            if not service or name.rpartition("/")[0] == action:
                with self._lock:
                    part, at = server.death
                    if service and service != part and now - at < _ONE_DEATH_S:
                        continue
                    server.death = service, now
                    server.accepted.clear()
                    ended, server.open = server.open, {}
                self._refuse(name, ended.values(), Refusal.CRASHED)

    def left_ros(self) -> None:
        """Note that our own node is gone: queued goals are refused, others get no answer."""
        for name, server in self._servers.items():
            with self._lock:
                unbegun = [server.open.pop(known.goal) for known in server.queue]
                for known in server.open.values():
                    known.unheard = True
            self._refuse(name, unbegun, Refusal.NOT_READY)

    def _refuse(self, service: str, ended: Collection[_Open], reason: Refusal) -> None:
        client = self._clients.get(service)
        for known in ended:
            if client is not None and known.ticket is not None:
                client.forget(known.ticket)
            for _, incoming in known.waiting:
                incoming.refuse(reason if known.begun_at is not None else Refusal.NOT_READY)
