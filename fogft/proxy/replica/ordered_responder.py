"""The replica's side of one stateful service: carries out what `OrderedReplica` decides.

Orders come from the link's threads, responses from the ROS thread. The lock is held while a
decision is made, never while sending.
"""

import logging
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from fogft.errors import RosError, Unreadable
from fogft.link.port import Incoming
from fogft.model.refusal import Refusal
from fogft.ordering import orders
from fogft.ordering.orders import Op, OrderError
from fogft.ordering.replica import Begin, OrderedReplica, Refuse, Reply
from fogft.proxy.replica.service_queue import LONGEST_FADES, most_quiet_s
from fogft.ros.port import RosClient
from fogft.ros.state_bytes import StateBytes

log = logging.getLogger(__name__)

_LIMITS_S = {Op.SNAPSHOT: 30.0, Op.RESTORE: 300.0}


class Clients(NamedTuple):
    """Clients of the three local services: the service, its snapshot and its restore."""

    service: RosClient
    snapshot: RosClient
    restore: RosClient


@dataclass(eq=False)
class OrderedResponder:
    """Applies the requests of one stateful service in order."""

    name: str
    state: StateBytes
    clock: Callable[[], float]

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._machine: OrderedReplica[Incoming] = OrderedReplica()
        self._clients: Clients | None = None
        self._begun: Begin | None = None
        self._begun_at = self._longest_s = self._given_s = 0.0
        self._again: Begin | None = None  # to retry, since ROS did not take it
        self.detail = ""

    @property
    def ready(self) -> bool:
        """Whether it has the current state and applies requests."""
        return self._machine.current

    @property
    def complete(self) -> bool:
        """Whether the service and those for its state are all available."""
        return all(client.available() for client in self._clients or ())

    @property
    def in_flight(self) -> int:
        """The number of unanswered requests."""
        return self._machine.in_flight

    def quiet_s(self, *, stuck: bool = False) -> float:
        """Return for how many seconds its service has worked on one request, if it hangs; else 0.

        `stuck`: only if it must be restarted. For plain services: `ServiceQueue`.
        """
        begun, longest_s = self._begun, self._longest_s
        if begun is None or begun.op is not Op.APPLY or not longest_s:
            return 0.0  # a service that has never answered may still be loading
        most_s = max(most_quiet_s(longest_s, stuck=stuck), self._given_s if stuck else 0.0)
        quiet_s = self.clock() - self._begun_at
        return quiet_s if quiet_s > most_s else 0.0

    def use(self, clients: Clients | None) -> None:
        """Set the clients of the local services; None without a ROS node."""
        with self._lock:
            self._clients = clients
            self._machine.serving = False

    def request(self, incoming: Incoming) -> None:
        """Take an order from the link. Never blocks."""
        try:
            op, epoch, index = orders.decode(incoming.request_id)
        except OrderError:
            incoming.refuse(Refusal.MALFORMED)
            return
        with self._lock:
            self._given_s = max(self._given_s, incoming.remaining_s)
            try:
                effects = self._machine.order(
                    op, epoch, index, incoming.payload, robot=incoming.robot, to=incoming
                )
            except OrderError:
                effects = [Refuse(incoming, Refusal.MALFORMED)]
        incoming.payload = b""  # a repeated order waits without its payload
        self._perform(effects)

    def _perform(self, effects: list[Any]) -> None:
        for effect in effects:
            if isinstance(effect, Reply):
                effect.to.reply(effect.payload)
            elif isinstance(effect, Refuse):
                effect.to.refuse(effect.reason, effect.detail)
            else:
                self._begin(effect)

    def _begin(self, begin: Begin) -> None:
        with self._lock:
            if not self._machine.works_on(begin.serial):
                return  # its service has died since, and a new one must not get it
            self._begun, self._begun_at = begin, self.clock()
            clients = self._clients
        try:
            if clients is None:
                raise RosError("ROS has shut down")
            if begin.op is Op.APPLY:
                clients.service.call(begin.payload, lambda answer: self._done(begin, answer))
            elif begin.op is Op.SNAPSHOT:
                request = self.state.snapshot_request()
                clients.snapshot.call(request, lambda answer: self._answered(begin, answer))
            else:
                request = self.state.restore_request(begin.payload)
                clients.restore.call(request, lambda answer: self._answered(begin, answer))
        except Unreadable as error:
            log.warning("request_unreadable service=%s reason=%r", self.name, error.message)
            self._done(begin, None)
        except RosError as error:
            if begin.op is Op.APPLY:
                log.warning("request_not_passed_on service=%s reason=%r", self.name, error.message)
                self._again = begin
            else:
                self._failed(begin, error)

    def _answered(self, begin: Begin, response: bytes) -> None:
        answer = b""
        try:
            if begin.op is Op.SNAPSHOT:
                answer = self.state.read_snapshot(response)
            else:
                self.state.check_restored(response)
                log.info("state_restored service=%s bytes=%d", self.name, len(begin.payload))
        except RosError as error:
            self._failed(begin, error)
        else:
            self._done(begin, answer)

    def _failed(self, begin: Begin, error: RosError) -> None:
        what = begin.op.name.lower()
        self.detail = f"the {what} of `{self.name}` failed: {error.message}"
        log.error("state_%s_failed service=%s reason=%r", what, self.name, error.message)
        self._done(begin, None)

    def _done(self, begin: Begin, answer: bytes | None) -> None:
        with self._lock:
            if self._begun is begin:
                self._begun = None
                if begin.op is Op.APPLY and answer is not None:
                    took_s = self.clock() - self._begun_at
                    self._longest_s = max(took_s, self._longest_s * LONGEST_FADES)
                    self._given_s *= LONGEST_FADES
            if answer is not None:
                self.detail = ""
            effects = self._machine.done(begin.serial, answer)
        self._perform(effects)

    def crashed(self) -> None:
        """Note that the service has died and lost its state."""
        with self._lock:
            self._again = self._begun = None
            self._longest_s = self._given_s = 0.0  # nothing is known about a new process
            effects = self._machine.lost()
        self._perform(effects)

    def tick(self, alive: bool) -> None:
        """Look for the services, and retry calls that ROS rejected. Call at about 10 Hz."""
        clients = self._clients
        known = [client.is_known() for client in clients or ()]  # a list, to probe all at once
        there = clients is not None and all(known) and all(c.available() for c in clients)
        with self._lock:
            self._machine.serving = alive and there
            again, self._again = self._again, None
            begun = self._begun
            waited_s = self.clock() - self._begun_at
        if again is not None:
            self._begin(again)
        elif begun is not None and waited_s > _LIMITS_S.get(begun.op, math.inf):
            self._failed(begun, RosError(f"no answer for {waited_s:.0f} s"))
