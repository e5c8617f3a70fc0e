"""A service server and a client over `rmw_zenoh`: bytes in and out, no type loaded.

Each has one thread for Zenoh calls that may block: querying, replying, declaring. Callbacks run
on Zenoh's threads.

Owns: queries in progress, on either side. Not here: the session and the graph (`node`).
"""

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import zenoh
from zenoh import handlers

from fogft.counters import Counters
from fogft.errors import RosError, Unreadable
from fogft.link.zenoh import threads
from fogft.link.zenoh.work_queue import WorkQueue
from fogft.rmw_zenoh import naming
from fogft.ros.pacing.pacer import NodeProbes, Pacer

log = logging.getLogger(__name__)

# `rmw_zenoh` waits forever; callers here wait no longer than a request may take.
_TIMEOUT_S = 1e6
_CLOSE_LIMIT_S = 10.0
_CLIENTS_KEPT = 64


class _Handle(NamedTuple):
    query: Any
    attachment: bytes
    client: bytes


class Server:
    """A service server (`fogft.ros.port.RosServer`).

    It is offered under each type hash that clients may have, because in `rmw_zenoh` the hash is
    part of the key.
    """

    def __init__(
        self, session: Any, token: Callable[[str], naming.Token], hash: str,
        on_request: Callable[[bytes, Any], None], fault: Callable[[bytes], str],
        *, probes: NodeProbes, mismatch: Callable[[], str],
    ) -> None:  # fmt: skip
        self.mismatch = mismatch
        self._answered_ns = OrderedDict[bytes, int]()  # client -> when it got its last answer
        self._session = session
        self._fault = fault
        self._token = token
        self._on_request = on_request
        self.is_open = True  # whether it is offered
        self._faces: dict[str, tuple[Any, Any]] = {}
        self.name, self.type = token("").service, token("").type
        self._pacer = Pacer(self._reply, probes, self.name, client_of=lambda h: h.client)
        self._worker = _worker(self.name, Counters())
        self._declare(hash)

    def clients_hash(self, hash: str) -> None:
        """Also offer it to clients whose type has this hash."""
        self._worker.add(partial(self._declare, hash))

    def move(self, hash: str) -> bool:
        """Offer it under another hash, unless that may be the same; return whether it moves."""
        if all(naming.may_be_same(hash, known) for known in list(self._faces)):
            return False
        self._worker.add(self._undeclare)
        self._worker.add(partial(self._declare, hash))
        return True

    def _declare(self, hash: str) -> None:
        if not self.is_open or hash in self._faces:
            return
        if not all(naming.may_be_same(hash, known) for known in self._faces):
            log.error(
                "type_differs service=%s type=%s here=%s client=%s",
                self.name, self.type, next(iter(self._faces)), hash,
            )  # fmt: skip
            return
        if self._faces:
            log.warning("type_not_compared service=%s type=%s client=%s", self.name, self.type,
                        hash)  # fmt: skip
        token = self._token(hash)
        key = naming.service_key(token.domain, token.service, token.type, hash)
        heard = handlers.Callback(self._heard, indirect=False)
        # `complete`: clients query only servers that can answer for the whole key.
        queryable = self._session.declare_queryable(key, heard, complete=True)
        self._faces[hash] = (queryable, self._session.liveliness().declare_token(str(token)))

    def _heard(self, query: Any) -> None:
        if not self.is_open or query.payload is None or query.attachment is None:
            return  # dropped: the client is told that no answer comes
        try:
            attachment = query.attachment.to_bytes()
            client, sent_ns = naming.sent_by(attachment)
            handle = _Handle(query, attachment, client)
            # A request sent before the last answer cannot be a reaction to it: it is in a burst.
            self._pacer.requested(handle, together=sent_ns < self._answered_ns.get(client, 0))
            self._on_request(query.payload.to_bytes(), handle)
        except Exception:
            log.exception("%s: a request was lost", self.name)

    def respond(self, handle: Any, payload: bytes) -> None:
        """Send the serialised response; does nothing once the service is withdrawn."""
        _check(self._fault(payload), payload)
        if self.is_open:
            self._pacer.respond(handle, payload)

    def _reply(self, handle: _Handle, payload: bytes) -> None:
        if self.is_open:
            self._answered_ns[handle.client] = time.time_ns()
            if len(self._answered_ns) > _CLIENTS_KEPT:
                self._answered_ns.popitem(last=False)
            self._worker.add(partial(self._send, handle, payload))

    def _send(self, handle: _Handle, payload: bytes) -> None:
        query, attachment, _ = handle
        try:
            query.reply(
                query.key_expr,
                payload,
                encoding=query.encoding or zenoh.Encoding.APPLICATION_CDR,
                attachment=naming.response_attachment(attachment, time.time_ns()),
            )
        finally:
            query.drop()

    def close(self) -> None:
        """Withdraw the service. Idempotent."""
        if self.is_open:
            self.is_open = False
            self._pacer.close()
            self._worker.add(self._undeclare)
            self._worker.close()
            self._worker.join(_CLOSE_LIMIT_S)

    def _undeclare(self) -> None:
        for queryable, token in self._faces.values():
            token.undeclare()
            queryable.undeclare()
        self._faces.clear()


class _Waiting(NamedTuple):
    on_response: Callable[[bytes], None]
    cancellation: Any


class Client:
    """A client (`fogft.ros.port.RosClient`); `servers` returns the type hash of each server now."""

    def __init__(
        self, session: Any, token: Callable[[str], naming.Token],
        servers: Callable[[], list[str]], fault: Callable[[bytes], str],
    ) -> None:  # fmt: skip
        self._session = session
        self._fault = fault
        self._token = token
        self._hashes = servers
        self._name = token("").service
        self._told: tuple[naming.Token, Any] | None = None
        self._waiting: dict[int, _Waiting] = {}
        self._asked = 0
        self._counters = Counters()
        self.is_open = True  # whether calls are accepted
        self._lock = threading.Lock()
        self._worker = _worker(self._name, self._counters)

    def available(self) -> bool:
        """Whether any node offers this service."""
        return self.servers() > 0

    def is_known(self) -> bool:
        """Return True: a reply always goes back to where its query came from."""
        return True

    def mismatch(self) -> str:
        """Return an empty string: Zenoh's graph has nodes of one middleware only."""
        return ""

    def servers(self) -> int:
        """Count the nodes that offer the service."""
        return len(self._hashes()) if self.is_open else 0

    def call(self, payload: bytes, on_response: Callable[[bytes], None]) -> int:
        """Send a serialised request; return its ticket. Raises RosError: nobody offers it."""
        _check(self._fault(payload), payload)
        hashes = self._hashes()
        with self._lock:
            if not self.is_open:
                raise RosError(f"the client of `{self._name}` is closed")
            if not hashes:
                raise RosError(f"nobody offers `{self._name}`")
            self._asked += 1
            ticket = self._asked
            self._waiting[ticket] = _Waiting(on_response, zenoh.CancellationToken())
        self._worker.add(partial(self._ask, ticket, hashes[0], payload))
        return ticket

    def _ask(self, ticket: int, hash: str, payload: bytes) -> None:
        waiting = self._waiting.get(ticket)
        if waiting is None:
            return  # forgotten meanwhile
        token = self._tell(hash)
        self._session.get(
            naming.service_key(token.domain, token.service, token.type, hash),
            handlers.Callback(partial(self._replied, ticket),
                              partial(self._waiting.pop, ticket, None), indirect=False),
            payload=payload,
            attachment=naming.request_attachment(ticket, time.time_ns(), token.gid),
            encoding=zenoh.Encoding.APPLICATION_CDR,
            target=zenoh.QueryTarget.ALL_COMPLETE,
            # NONE: by default Zenoh holds back the first reply until the last one.
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=_TIMEOUT_S,
            cancellation_token=waiting.cancellation,
        )  # fmt: skip

    def _tell(self, hash: str) -> naming.Token:
        """Declare this client in the graph, with the server's type hash."""
        if self._told is not None and self._told[0].hash == hash:
            return self._told[0]
        token = self._token(hash)
        if self._told is not None:
            self._told[1].undeclare()
        self._told = (token, self._session.liveliness().declare_token(str(token)))
        return token

    def _replied(self, ticket: int, reply: Any) -> None:
        threads.note()
        if reply.ok is None:
            self._counters.warn(log, "errors", "%s: an error came for a response", self._name)
            return
        with self._lock:
            waiting = self._waiting.pop(ticket, None)
        if waiting is None:
            return
        try:
            waiting.on_response(reply.ok.payload.to_bytes())
        except Exception:
            log.exception("%s: a response was lost", self._name)

    def forget(self, ticket: int) -> None:
        """Drop a pending request; unknown tickets are ignored."""
        with self._lock:
            waiting = self._waiting.pop(ticket, None)
        if waiting is not None:
            self._worker.add(waiting.cancellation.cancel)

    def close(self) -> None:
        """Withdraw the client. Idempotent."""
        with self._lock:
            if not self.is_open:
                return
            self.is_open = False
            left, self._waiting = self._waiting, {}
        for waiting in left.values():
            self._worker.add(waiting.cancellation.cancel)
        self._worker.add(self._undeclare)
        self._worker.close()
        self._worker.join(_CLOSE_LIMIT_S)

    def _undeclare(self) -> None:
        if self._told is not None:
            self._told[1].undeclare()
            self._told = None


def _worker(service: str, counters: Counters) -> WorkQueue:
    worker = WorkQueue(f"rmw{service}", counters)
    worker.start()
    return worker


def _check(fault: str, payload: bytes) -> None:
    if fault:
        raise Unreadable(f"{len(payload)} bytes are not a serialised message: {fault}")
