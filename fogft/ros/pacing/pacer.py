"""Send responses no faster than their clients take them.

A client keeps the last ten responses that it has not taken yet and silently loses more; what its
queue has no room for waits here. One that discovery has not found yet gets its first response again
until it has; the others wait behind it.

Owns: the responses that wait, the thread that sends them, and probes of clients' nodes. Not here:
when one may be sent (`pace`), sending it (`entities`).
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from functools import partial
from operator import itemgetter
from typing import Any

from fogft.errors import RosError
from fogft.process import on_thread
from fogft.ros.pacing.pace import EVERY_S, ClientPace, Pace, Probing
from fogft.ros.port import NotFoundYet, RosClient

log = logging.getLogger(__name__)

# Whether a node answers probes. On a busy machine discovery takes long to tell.
_ASK_EVERY_S, _ASK_LIMIT_S, _ASK_AGAIN_S = 0.02, 2.0, 10.0
_LOOK_EVERY_S = 0.2
_GUID_BYTES = 16
PROBED, PROBED_TYPE = "get_parameter_types", "rcl_interfaces/srv/GetParameterTypes"
EMPTY_LIST = b"\x00\x01\x00\x00" + bytes(4)  # of names of parameters
KEPT = 64

_Due = tuple[bytes, ClientPace, Any, bytes]  # a response to a client, by its id and handle


@dataclass(eq=False)
class NodeProbes:
    """Probes of the nodes in one ROS domain, for the clients of all services. Any thread.

    A node answers the services of its parameters by the same executor that takes its clients'
    responses, one in each turn: an answer means that there was a turn.

    Args:
        make_client: As `RosNode.client`.
        same_node_serves: Returns the full name of the service of a last name, of the node that a
            client of a service belongs to: None while it is not discovered, empty without one.
    """

    make_client: Callable[[str, str], RosClient]
    same_node_serves: Callable[[str, str, bytes], str | None]

    def __post_init__(self) -> None:
        self._by_name: dict[str, RosClient] = {}
        self._by_client: dict[bytes, RosClient] = {}
        self._lock = threading.Lock()

    def answers(self, service: str, client: bytes) -> bool | None:
        """Whether the node of a service's client answers probes; None while it is not known."""
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
            if len(self._by_client) >= 4 * KEPT:  # long gone
                self._by_client.pop(next(iter(self._by_client)))
            self._by_client[client] = end
        return True

    def same_node(self, client: bytes, other: bytes) -> bool:
        """Whether two clients' nodes have one name: one was started again as the other."""
        return self._by_client.get(client) is self._by_client.get(other)

    def send(self, client: bytes, on_answer: Callable[[], None]) -> None:
        """Try to send a probe; `on_answer` is called from the take loop, or never."""
        with contextlib.suppress(KeyError, RosError):
            self._by_client[client].call(EMPTY_LIST, lambda _: on_answer())


@dataclass(eq=False)
class Pacer:
    """Sends the responses of one service, at each client's pace. Any thread.

    Args:
        probes: Asks the clients' nodes.
        client_of: Returns who asked, of a request's handle: of its header in DDS, if not given.
    """

    send: Callable[[Any, bytes], None]
    probes: NodeProbes
    service: str
    _: KW_ONLY
    clock: Callable[[], float] = time.monotonic
    client_of: Callable[[Any], bytes] = itemgetter(slice(_GUID_BYTES))

    def __post_init__(self) -> None:
        self._pace = Pace()
        self._held: dict[bytes, ClientPace] = {}  # those whose responses wait
        self._asked: dict[bytes, float] = {}  # whose nodes may answer probes: until when
        self._lock = threading.Lock()
        self._wake = threading.Condition(self._lock)
        self._thread: threading.Thread | None = None  # made when there is something to wait for
        self._closed = False

    def requested(self, handle: Any, *, together: bool = False) -> None:
        """Note a request as it is taken; `together` with the one before it."""
        now = self.clock()
        id = self.client_of(handle)
        with self._lock:
            client = self._pace.clients.get(id) or self._pace.client(id, now)
            client.requested(now, together=together)
            if client.probing in (Probing.ASKED, Probing.NO) and now >= client.ask_again_at:
                client.ask_again_at = now + _ASK_AGAIN_S
                # Of a node that has long been known one look is enough.
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
        """Send now; have it wait if the client is not found yet. Raises RosError."""
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
            raise
        client.finding_until = None

    def _begin(self) -> None:
        if self._thread is None:
            # Where that fails, the next response tries it again.
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

    def _step(self, now: float) -> tuple[list[_Due], list[bytes], float | None]:
        """Return what to send now, whom to probe, each as often, how long to wait if nothing."""
        due: list[_Due] = []
        in_the_way: dict[bytes, ClientPace] = {}
        for id, client in list(self._held.items()):
            finding = client.finding_until is not None
            if finding and now < client.find_again_at:
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
        if self._asked:
            return due, probed, _ASK_EVERY_S
        by_time = any(not client.strict for client in in_the_way.values())
        if by_time or any(client.finding_until for client in self._held.values()):
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
                return  # or what a killed node left open would push out its successor's responses
            client.answered_probe(now)
            self._wake.notify()

    def close(self) -> None:
        """Stop sending; queued responses are dropped. Repeatable."""
        with self._wake:
            self._closed = True
            self._wake.notify()
