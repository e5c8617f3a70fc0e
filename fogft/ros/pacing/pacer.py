"""Send responses no faster than their clients take them.

A client keeps the last ten responses that it has not taken yet and silently loses older ones, so
responses that do not fit in its queue wait here. For a client that discovery has not found yet, all
wait until it has: ROS waits 0.1 s for one that is gone, and sends nothing to others meanwhile.

Owns: the waiting responses, the thread that sends them, and probes of clients' nodes. Not here:
when a response may be sent (`pace`), sending it (`entities`).
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Collection
from dataclasses import KW_ONLY, dataclass
from functools import partial
from operator import itemgetter
from typing import Any

from fogft.errors import RosError
from fogft.process import on_thread
from fogft.ros.pacing.pace import EVERY_S, ClientPace, Pace, Probing
from fogft.ros.port import NotFoundYet, RosClient

log = logging.getLogger(__name__)

# For checking whether a node answers probes. On a busy machine discovery is slow.
_ASK_EVERY_S, _ASK_LIMIT_S, _ASK_AGAIN_S = 0.02, 2.0, 10.0
_LOOK_EVERY_S = 0.2
_GUID_BYTES = 16
PROBED, PROBED_TYPE = "get_parameter_types", "rcl_interfaces/srv/GetParameterTypes"
EMPTY_LIST = b"\x00\x01\x00\x00" + bytes(4)  # of parameter names
KEPT = 64

_Due = tuple[bytes, ClientPace, Any, bytes]  # a response to a client, by its id and handle


@dataclass(eq=False)
class NodeProbes:
    """Probes the nodes of all services' clients in one ROS domain. Any thread.

    A node's executor serves its parameter services and takes its clients' responses, one of each
    per turn, so an answer to a probe means that there was a turn.

    Args:
        make_client: As `RosNode.client`.
        same_node_serves: Takes a service's last name, another service and a client of the latter.
            Returns the first one's full name on the client's node; None: unknown, empty: none.
        found: Returns those of these clients of a service that discovery lists.
    """

    make_client: Callable[[str, str], RosClient]
    same_node_serves: Callable[[str, str, bytes], str | None]
    found: Callable[[str, Collection[bytes]], Collection[bytes]] = lambda service, clients: clients

    def __post_init__(self) -> None:
        self._by_name: dict[str, RosClient] = {}
        self._by_client: dict[bytes, RosClient] = {}
        self._lock = threading.Lock()

    def answers(self, service: str, client: bytes) -> bool | None:
        """Whether the node of a service's client answers probes; None while unknown."""
        asked = self.same_node_serves(PROBED, service, client)
        if not asked:
            return None if asked is None else False
        with self._lock:
            end = self._by_name.get(asked)
            if end is None:
                if len(self._by_name) >= KEPT:
                    self._by_name.pop(next(iter(self._by_name))).close()
                try:
                    end = self._by_name[asked] = self.make_client(asked, PROBED_TYPE)
                except RosError:
                    return False
            if not end.available():
                return None
            if len(self._by_client) >= 4 * KEPT:  # the oldest is long gone
                self._by_client.pop(next(iter(self._by_client)))
            self._by_client[client] = end
        return True

    def same_node(self, client: bytes, other: bytes) -> bool:
        """Whether two clients' nodes have the same name: one is a restart of the other."""
        return self._by_client.get(client) is self._by_client.get(other)

    def send(self, client: bytes, on_answer: Callable[[], None]) -> None:
        """Try to send a probe; `on_answer` is called from the take loop, or never."""
        with contextlib.suppress(KeyError, RosError):
            self._by_client[client].call(EMPTY_LIST, lambda _: on_answer())


@dataclass(eq=False)
class Pacer:
    """Sends the responses of one service, at each client's pace. Any thread.

    Args:
        probes: Probes the clients' nodes.
        client_of: Returns the client's id from a request's handle; default: from its DDS header.
    """

    send: Callable[[Any, bytes], None]
    probes: NodeProbes
    service: str
    _: KW_ONLY
    clock: Callable[[], float] = time.monotonic
    client_of: Callable[[Any], bytes] = itemgetter(slice(_GUID_BYTES))

    def __post_init__(self) -> None:
        self._pace = Pace()
        self._held: dict[bytes, ClientPace] = {}  # clients with waiting responses
        self._asked: dict[bytes, float] = {}  # clients to check for probes: until when
        self._lock = threading.Lock()
        self._wake = threading.Condition(self._lock)
        self._find_at = self.clock()
        self._thread: threading.Thread | None = None  # started on demand
        self._closed = False

    def requested(self, handle: Any, *, together: bool = False) -> None:
        """Record a request when it is taken; `together` with the one before it."""
        now = self.clock()
        id = self.client_of(handle)
        with self._lock:
            client = self._pace.clients.get(id) or self._pace.client(id, now)
            client.requested(now, together=together)
            if client.probing in (Probing.ASKED, Probing.NO) and now >= client.ask_again_at:
                client.ask_again_at = now + _ASK_AGAIN_S
                # For a node that has been known for long, one check is enough.
                self._asked[id] = now + (_ASK_LIMIT_S if client.strict else 0.0)
                self._begin()
            elif client.waiting:
                self._wake.notify()

    def respond(self, handle: Any, payload: bytes) -> None:
        """Send a response now, or as soon as its client has room.

        Raises RosError: It was sent now, and ROS refused it.
        """
        now = self.clock()
        id = self.client_of(handle)
        with self._lock:
            client = self._pace.clients.get(id) or self._pace.client(id, now)
            if client.waiting or client.finding_until or not self._pace.take(client, now):
                if client.hold(handle, payload, now):
                    self._held[id] = client
                    self._begin()
                    return
                self._pace.send(client)
        self._try(id, client, handle, payload)

    def _try(self, id: bytes, client: ClientPace, handle: Any, payload: bytes) -> None:
        """Send now; requeue it if the client is not discovered yet. Raises RosError."""
        try:
            self.send(handle, payload)
        except NotFoundYet:
            now = self.clock()
            with self._wake:
                if client.finding_until is None or now < client.finding_until:
                    client.not_found(handle, payload, now)
                    self._held[id] = client
                    self._begin()
                    return
                client.give_up()
            raise
        client.finding_until = None

    def _begin(self) -> None:
        if self._thread is None:
            # If that fails, the next response tries again.
            self._thread = on_thread(self._run, name="ros-pacer")
        self._wake.notify()

    def _run(self) -> None:
        while True:
            with self._wake:
                due, probed, wait_s = self._step(self.clock())
                if not due and not probed and not self._closed:
                    self._wake.wait(wait_s)
                    due, probed, wait_s = self._step(self.clock())
                asked = list(self._asked)
                finding = {i: c for i, c in self._held.items() if c.finding_until is not None}
                if self._closed:
                    return
            for id, client, handle, payload in due:
                try:
                    self._try(id, client, handle, payload)
                except RosError as error:
                    log.warning("response_refused reason=%r", error.message)
            for id in probed:
                self.probes.send(id, partial(self._answered, id))
            for id in asked:
                self._ask(id)
            if finding and (now := self.clock()) >= self._find_at:
                for id in self.probes.found(self.service, finding):
                    finding[id].find_again_at = now
                # Among many clients it takes long: at most a tenth of the time.
                self._find_at = now + max(_ASK_EVERY_S, 10 * (self.clock() - now))

    def _step(self, now: float) -> tuple[list[_Due], list[bytes], float | None]:
        """Return the due responses, a client id per probe, and how long to wait if none."""
        due: list[_Due] = []
        in_the_way: dict[bytes, ClientPace] = {}
        for id, client in list(self._held.items()):
            finding = client.finding_until is not None
            if finding and (now < client.find_again_at or any(c.finding_until for _, c, *_ in due)):
                continue
            while client.waiting and self._pace.take(client, now):
                due.append((id, client, *client.next(now)))
                if finding:
                    break
            if client.waiting:
                in_the_way.update(self._pace.in_the_way(client, now))
            else:
                del self._held[id]
        probed = []
        for id, client in in_the_way.items():
            probed += [id] * client.probes_due(now, self._pace.sent)
        if self._asked or any(client.finding_until for client in self._held.values()):
            return due, probed, _ASK_EVERY_S
        if any(not client.strict for client in in_the_way.values()):
            return due, probed, EVERY_S
        return due, probed, _LOOK_EVERY_S if self._held else None

    def _ask(self, id: bytes) -> None:
        answers = self.probes.answers(self.service, id)
        now = self.clock()
        with self._wake:
            if answers is None and now < self._asked.get(id, now):
                return
            self._asked.pop(id, None)
            self._pace.client(id, now).probing = Probing.YES if answers else Probing.NO

    def _answered(self, id: bytes) -> None:
        now = self.clock()
        with self._wake:
            client = self._pace.client(id, now)
            later = [i for i, o in self._pace.clients.items() if o.asked_at > client.asked_at]
            if client.silent(now) and any(self.probes.same_node(id, other) for other in later):
                return  # else responses to a killed node would push out its successor's
            client.answered_probe(now)
            self._wake.notify()

    def close(self) -> None:
        """Stop sending; queued responses are dropped. Idempotent."""
        with self._wake:
            self._closed = True
            self._wake.notify()
