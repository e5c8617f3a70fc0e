"""The robot's side of dial-out: a port that replicas connect to if the robot cannot reach them.

A replica dials this port, the door, authenticates and waits. A link to that replica dials a port
on this machine's loopback; the door then joins both connections. TLS runs end to end, with the
robot as client and the replica as server, so the door can neither read nor change the traffic.
"""

import contextlib
import logging
import secrets
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import KW_ONLY, dataclass
from functools import partial

from fogft import poll
from fogft.counters import Counters
from fogft.link.dial_out import tunnel
from fogft.model.credentials import Role, holder_of
from fogft.model.replica import ReplicaId
from fogft.process import on_thread
from fogft.records import frames
from fogft.records.accepting import listening, oldest_of_most
from fogft.records.record import RecordError, Verify

log = logging.getLogger(__name__)

PURPOSE = "dial-in"
SIGN, GO = b".", b"G"
SIGN_EVERY_S = 1.0
SILENCE_S = 3.0
WAITING_LIMIT = 4  # of one replica
REPLICAS_LIMIT = 64
GREETINGS_LIMIT = 64
_PATIENCE_S = 1.0


class _Waiting:
    def __init__(self, id: ReplicaId, link: socket.socket) -> None:
        self.id = id
        self.link = link
        self.lock = threading.Lock()  # held while reading or writing `link`
        self.taken = False


@dataclass(eq=False)
class DialIn:
    """The dial-in port of a robot or gateway, at `listen` (``host:port``, port 0 for any free one).

    Replicas of other pools, and `revoked` common names, are rejected. Raises WireError: the port
    cannot be bound.
    """

    listen: str
    pool_uid: str
    verify: Verify
    _: KW_ONLY
    revoked: Callable[[], Collection[str]] = frozenset

    def __post_init__(self) -> None:
        self._counters = Counters()
        self.counters = self._counters.snapshot
        self._lock = threading.Condition()
        self._waiting: list[_Waiting] = []  # oldest first
        self._local: dict[ReplicaId, socket.socket] = {}
        self._tunnels = tunnel.Tunnels()
        self._greeting: dict[socket.socket, str] = {}  # oldest first, with their hosts
        self._closed = False
        self._door = listening(self.listen)
        host, port = self.listen.rpartition(":")[0], self._door.getsockname()[1]
        self.endpoint = f"{host}:{port}"
        on_thread(self._accept, self._door, self._receive, name="fogft-dial-in")

    # -- connections from replicas ------------------------------------------------------------

    def _receive(self, link: socket.socket, address: tuple[str, int]) -> None:
        with self._lock:
            if len(self._greeting) >= GREETINGS_LIMIT:
                crowd = oldest_of_most(self._greeting)
                self._count("greeting_crowded", self._greeting.pop(crowd))
                tunnel.shut_down(crowd)  # its thread closes it
            on_thread(self._attend, link, address[0], name="fogft-greet")
            self._greeting[link] = address[0]

    def _accept(self, port: socket.socket, receive: Callable[..., None]) -> None:
        """Pass on each connection to a port and its address, until it is closed."""
        while True:
            try:
                receive(*port.accept())
            except OSError as error:
                if self._closed or port.fileno() < 0:
                    return
                self._count("accept_failed", str(error))  # e.g. out of descriptors or threads
                time.sleep(0.1)

    def _attend(self, link: socket.socket, host: str) -> None:
        try:
            try:
                id = self._greet(link, host)
            finally:
                with self._lock:
                    self._greeting.pop(link, None)
        except (RecordError, OSError, EOFError) as error:
            reason = error.reason if isinstance(error, RecordError) else "failed"
            self._count(f"greeting_{reason}", f"{host}: {error}")
            tunnel.hang_up(link)
        else:
            self._wait(_Waiting(id, link))

    def _greet(self, link: socket.socket, host: str) -> ReplicaId:
        tunnel.keep_alive(link)
        link.settimeout(tunnel.GREETING_TIMEOUT_S)
        nonce = secrets.token_bytes(frames.NONCE_BYTES)
        link.sendall(frames.challenge(nonce, host))
        message = tunnel.receive(link, 16 << 10)
        certificate, signature = frames.read_greeting(message)
        proof = frames.proof_bytes(PURPOSE, nonce, self.pool_uid.encode())
        writer = self.verify(certificate, signature, proof)
        try:
            holder = holder_of(writer.common_name)
        except ValueError as error:
            raise RecordError("role", str(error)) from error
        if (holder.role, writer.role) != (Role.REPLICA, Role.REPLICA.value):
            raise RecordError("role", f"`{writer.common_name}` is not a replica")
        if holder.pool_uid != self.pool_uid:
            raise RecordError("pool", f"`{writer.common_name}` is another pool's")
        if writer.common_name in self.revoked():
            raise RecordError("revoked", f"`{writer.common_name}` is revoked")
        return ReplicaId(self.pool_uid, int(holder.name), holder.generation)

    def _wait(self, one: _Waiting) -> None:
        with self._lock:
            of_each = Counter(other.id for other in (*self._waiting, one))
            too_many = of_each[one.id] > WAITING_LIMIT or len(of_each) > REPLICAS_LIMIT
            if too_many or self._closed:
                tunnel.hang_up(one.link)
                self._counters.add("refused_full")
                return
            self._waiting.append(one)
            self._lock.notify_all()
        self._counters.add("admitted")
        log.info("replica_dialled_in replica=%s", one.id.short)
        why = self._tend(one)
        if why:
            log.info("replica_left_door replica=%s reason=%s", one.id.short, why)
            with self._lock, contextlib.suppress(ValueError):  # `_take` just took it
                self._waiting.remove(one)
            tunnel.hang_up(one.link)

    def _tend(self, one: _Waiting) -> str:
        """Exchange keepalives; return why the connection ended, or "" once a link uses it."""
        began = heard_at = time.monotonic()
        signs = 0
        while True:
            readable = poll.is_ready(one.link, SIGN_EVERY_S)
            with one.lock:
                if one.taken:
                    return ""
                try:
                    if readable:
                        one.link.settimeout(0.0)
                        data = one.link.recv(64)
                        if not data:
                            return "it closed the connection"
                        signs += len(data)  # after a stall several come at once
                        if data.strip(SIGN) or signs > 8 + 2 * (time.monotonic() - began):
                            return "it sent something unexpected"
                        heard_at = time.monotonic()
                    else:
                        one.link.settimeout(0.5)
                        one.link.sendall(SIGN)
                except (OSError, ValueError) as error:
                    return str(error)
            if self._closed:
                return "the port is closed"
            if time.monotonic() - heard_at > SILENCE_S:
                return "it sends nothing"

    # -- connections from our links -----------------------------------------------------------

    def local(self, id: ReplicaId) -> str:
        """Return the ``host:port`` on this machine through which a link reaches a replica."""
        with self._lock:
            port = self._local.get(id)
            if port is None:
                port = listening("127.0.0.1:0")
                on_thread(self._accept, port, partial(self._connect, id), name="fogft-door")
                self._local[id] = port
            return f"127.0.0.1:{port.getsockname()[1]}"

    def keep(self, ids: Collection[ReplicaId]) -> None:
        """Close the loopback ports of all other replicas."""
        with self._lock:
            gone = [self._local.pop(id) for id in list(self._local) if id not in ids]
        for port in gone:
            tunnel.hang_up(port)

    def _connect(self, id: ReplicaId, link: socket.socket, _: object) -> None:
        one = self._take(id)
        if one is None:
            link.close()  # the link retries soon
            return
        self._tunnels.carry(link, one.link)
        self._counters.add("tunnels")

    def _take(self, id: ReplicaId) -> _Waiting | None:
        """Return a replica's connection for use, waiting briefly for one; None if none came."""
        until = time.monotonic() + _PATIENCE_S
        while True:
            with self._lock:
                while not (found := [one for one in self._waiting if one.id == id]):
                    if not self._lock.wait(until - time.monotonic()) or self._closed:
                        return None
                one = found[-1]  # the newest is the most likely to be alive
                self._waiting.remove(one)
            with one.lock, contextlib.suppress(OSError):
                one.taken = True
                one.link.settimeout(0.5)
                one.link.sendall(GO)
                if _drained(one.link):
                    return one
            tunnel.hang_up(one.link)

    # -- the owner ----------------------------------------------------------------------------

    def waiting(self) -> Mapping[ReplicaId, int]:
        """Return how many connections of each replica are waiting."""
        with self._lock:
            return Counter(one.id for one in self._waiting)

    def _count(self, event: str, detail: str) -> None:
        self._counters.warn(log, event, "dial_in_refused event=%s detail=%r", event, detail[:200])

    def close(self) -> None:
        """Close the port and all its connections. Repeatable."""
        self._closed = True
        tunnel.hang_up(self._door)
        self.keep(())
        with self._lock:
            tunnel.shut_down(*(one.link for one in self._waiting))
            self._lock.notify_all()
        self._tunnels.close()


def _drained(link: socket.socket) -> bool:
    """Discard keepalives up to the replica's `GO`; after that, the TLS client sends first."""
    link.settimeout(SILENCE_S)
    while (data := link.recv(1)) == SIGN:
        pass
    return data == GO
