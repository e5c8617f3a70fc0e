"""A replica's end over Zenoh: hear requests and probes, queue the answers of each robot apart.

Requests are published to us; a connection's answers are the replies to one query of its own,
which it asks once we have let it in, and which stays open.

Zenoh's threads only decode and hand over. Replies leave through one thread for each
connection of a robot, because replying to a frozen robot can block; probes are answered by
one more thread, ahead of all replies.

Owns: the session, its queryables, the reply threads. Not here: what a request is worth
(`fogft.proxy.responder`), duplicates included.
"""

from __future__ import annotations

import logging
import socket
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from queue import SimpleQueue
from typing import TypeVar

import zenoh
from zenoh import handlers

from fogft.core import names
from fogft.core.errors import WireError
from fogft.core.model import ReplicaId
from fogft.core.record_set import RecordSet, Verdict
from fogft.core.records import RecordError, SignedRecord
from fogft.core.repeats import worth_logging
from fogft.wire import batch_frames, config, frame, probe_frames, record_frames, sockets
from fogft.wire.compression import ACCEPTED, unpack
from fogft.wire.config import CredentialPaths, LinkSettings
from fogft.wire.doorkeeper import Doorkeeper
from fogft.wire.guests import Guests, NotAdmittedError
from fogft.wire.handshakes import HandshakeLog
from fogft.wire.leaving import see_off
from fogft.wire.port import Incoming, Probe, ProbeAnswer, Refusal
from fogft.wire.reply_queue import Counters, QueryTurns, Reply, ReplyQueues
from fogft.wire.signing import LazyVerifier
from fogft.wire.sockets import Address, address
from fogft.wire.streams import Streams
from fogft.wire.zenoh_incoming import ZenohIncoming

log = logging.getLogger(__name__)

Heard = TypeVar("Heard", zenoh.Query, zenoh.Sample)

_CLOSE_WAIT_S = 1.0
_NO_REQUEST = bytes(names.REQUEST_ID_BYTES)
_CHORES_LIMIT = 1024  # probes, records and recalls that wait; a robot has a few on the way
_STRANGERS = b""  # in place of a token: replies to whose connection is not known


class ZenohListener:
    """Listens for robots; see `port.Listener`.

    Args:
        listen: ``host:port``; port 0 for any that is free.
        credentials: The replica's certificate and key, and the pool's CA.
        id: Which replica this is: it hears the keys of its slot only.
        settings: Zenoh's times.
        handshakes: Tells which handshakes were refused; None where they need not be counted.
        certificate_name: The common name of its certificate, where that is not the replica's.

    Raises:
        WireError: `listen` is not ``host:port``.
    """

    def __init__(
        self,
        listen: str,
        credentials: CredentialPaths,
        id: ReplicaId,
        *,
        settings: LinkSettings | None = None,
        handshakes: HandshakeLog | None = None,
        certificate_name: str = "",
    ) -> None:
        self._endpoint = _with_port(listen)
        self._handshakes = handshakes
        self._doorkeeper: Doorkeeper | None = None
        self._id = id
        self._settings = settings or LinkSettings()
        self._config = config.replica_settings(self._endpoint, id, credentials, self._settings)
        self._guests = Guests(
            id.pool_uid,
            certificate_name or names.replica_certificate_name(id),
            LazyVerifier(credentials.ca),
        )
        self._records = RecordSet(id.pool_uid, LazyVerifier(credentials.ca))
        self._counters = Counters()
        self._turns = QueryTurns()
        self._queues = ReplyQueues(self._counters, self._turns)
        self._chores: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._session: zenoh.Session | None = None
        self._declared: list[object] = []
        self._streams = Streams()
        self._services: dict[str, str] = {}  # key -> service

    @property
    def _port(self) -> int:
        return int(self._endpoint.rpartition(":")[2])

    @property
    def endpoint(self) -> str:
        """``host:port`` as bound."""
        return self._endpoint

    def serve(
        self,
        services: Mapping[str, str],
        on_request: Callable[[Incoming], None],
        on_probe: Callable[[Probe], ProbeAnswer],
        on_cancel: Callable[[Sequence[bytes]], None] = lambda ids: None,
    ) -> None:
        """Begin to listen.

        Raises:
            WireError: The port is taken, or the credentials cannot be used.
        """
        try:
            session = self._session = zenoh.open(config.to_zenoh(self._config))
        except zenoh.ZError as error:
            raise WireError(
                f"cannot listen at `{self._endpoint}`: {str(error).split(' at /')[0]}",
                "see that the port is free and that the certificate, its key and the CA exist",
            ) from error
        threading.Thread(target=self._do_chores, name="fogft-probes", daemon=True).start()
        self._doorkeeper = Doorkeeper(
            self._port,
            self._peers,
            lambda: self._guests.revoked,
            self._counters,
            also=self._count_handshakes,
            stuck_after_s=self._settings.stuck_after_s,
        )
        self.add(services)
        place = self._id.pool_uid, self._id.slot
        self._hear(session, names.services_key(*place), partial(self._request, on_request))
        self._hear(session, names.cancel_key(*place), partial(self._cancel, on_cancel))
        self._declare(session, names.answers_key(*place), self._open_answers)
        self._declare(session, names.records_key(*place), self._heard_records)
        # Last: who is told that this replica is ready finds every service.
        self._declare(session, names.probe_key(*place), partial(self._probe, on_probe))

    def add(self, services: Mapping[str, str]) -> None:
        """Hear requests for further services too (name -> key)."""
        self._services.update((key, name) for name, key in services.items())

    def _peers(self) -> dict[Address, str]:
        session = self._session
        links = [] if session is None else session.info.links()
        return {address(link.dst): link.auth_identifier or "" for link in links}

    def _thin(self, token: bytes) -> bool:
        """Whether what a connection's robot is sent was seen to leave slowly."""
        doorkeeper = self._doorkeeper
        return doorkeeper is not None and self._guests.holder(token) in doorkeeper.thin

    def _count_handshakes(self) -> None:
        for reason in self._handshakes.refusals() if self._handshakes else ():
            self._count("handshakes_refused", "handshake_refused", reason)

    def _declare(
        self, session: zenoh.Session, key: str, heard: Callable[[zenoh.Query, int], None]
    ) -> None:
        callback = handlers.Callback(self._taken(f"query at {key}", heard), indirect=False)
        self._declared.append(session.declare_queryable(key, callback, complete=True))

    def _hear(
        self, session: zenoh.Session, key: str, heard: Callable[[zenoh.Sample], None]
    ) -> None:
        def told(sample: zenoh.Sample, turn: int) -> None:
            heard(sample)

        callback = handlers.Callback(self._taken(f"message at {key}", told), indirect=False)
        self._declared.append(session.declare_subscriber(key, callback))

    def _taken(self, what: str, heard: Callable[[Heard, int], None]) -> Callable[[Heard], None]:
        """Return what Zenoh's thread calls: nothing is raised there, where nobody would tell."""

        def guarded(one: Heard) -> None:
            turn = self._turns.came()
            try:
                heard(one, turn)
            except Exception:
                self._counters.add("failed")
                log.exception("not_taken what=%r", what)

        return guarded

    # -- Zenoh's threads ------------------------------------------------------------------

    def _request(self, on_request: Callable[[Incoming], None], sample: zenoh.Sample) -> None:
        attachment = sample.attachment
        head = attachment.to_bytes() if attachment else b""
        try:
            if batch_frames.is_batch(head):
                requests = batch_frames.decode_requests(head, sample.payload.to_bytes())
            else:
                requests = [(frame.decode_request(head), sample.payload.to_bytes())]
        except frame.FrameError as error:
            self._count("malformed", "request_malformed", error)
            return
        self._counters.add("requests", len(requests))
        token = requests[0][0].token
        stream = self._streams.of(token)
        if stream is None or not self._guests.admits(token):
            self._count("not_admitted", "robot_not_admitted", "it did not greet")
            if stream is not None:
                self._refuse_all(requests, stream, Refusal.NOT_ADMITTED)
            return
        service = self._services.get(str(sample.key_expr))
        if service is None:
            self._refuse_all(requests, stream, Refusal.NOT_READY)
            return
        for header, payload in requests:
            try:
                request = unpack(payload) if header.packed else payload
            except ValueError as error:
                self._count("malformed", "request_malformed", error)
                self._refuse(header, stream, Refusal.MALFORMED)
                continue
            incoming = ZenohIncoming(
                service,
                header,
                request,
                stream=stream,
                queues=self._queues,
                chores=self._chores,
                thin=self._thin,
            )
            try:
                on_request(incoming)
            except Exception:  # the others that came with it go on
                self._counters.add("failed")
                log.exception("request_not_taken service=%s", service)
                incoming.refuse(Refusal.LOST)

    def _refuse_all(
        self, requests: list[tuple[frame.RequestHeader, bytes]], stream: zenoh.Query, reason: str
    ) -> None:
        for header, _ in requests:
            self._refuse(header, stream, reason)

    def _refuse(self, header: frame.RequestHeader, stream: zenoh.Query, reason: str) -> None:
        self._queues.put(header.token, header.robot, Reply(stream, header.request_id, b"", reason))

    def _open_answers(self, query: zenoh.Query, turn: int) -> None:
        attachment = query.attachment
        try:
            greeting = frame.decode_greeting(attachment.to_bytes() if attachment else b"")
        except frame.FrameError as error:
            self._malformed(error, query, turn)
            return
        if not self._guests.admits(greeting.token):
            refused = Reply(query, _NO_REQUEST, b"", Refusal.NOT_ADMITTED, turn=turn)
            self._turn_away(refused, "it did not greet")
            return
        for token, ended in self._streams.opened(greeting.token, query):
            reply = Reply(ended, _NO_REQUEST, b"", "", turn=turn, ends_only=True)
            self._queues.put(token, "gone", reply)

    def _probe(
        self, on_probe: Callable[[Probe], ProbeAnswer], query: zenoh.Query, turn: int
    ) -> None:
        self._counters.add("probes")
        attachment = query.attachment
        try:
            probe = probe_frames.decode_probe(query.payload.to_bytes() if query.payload else b"")
            greeting = frame.decode_greeting(attachment.to_bytes() if attachment else b"")
        except frame.FrameError as error:
            self._malformed(error, query, turn)
            return
        answer = partial(self._answer_probe, on_probe, probe, greeting, query, turn)
        self._do_later(answer, query, turn)

    def _do_later(self, chore: Callable[[], None], query: zenoh.Query, turn: int) -> None:
        """Have the probe thread do something; where too much waits for it, the query just ends."""
        if self._chores.qsize() < _CHORES_LIMIT:
            self._chores.put(chore)
            return
        self._counters.add("chores_dropped")
        ended = Reply(query, _NO_REQUEST, b"", "", turn=turn, ends_only=True)
        self._queues.put(_STRANGERS, "strangers", ended)

    def _turn_away(self, refused: Reply, why: str) -> None:
        self._count("not_admitted", "robot_not_admitted", why)
        self._queues.put(_STRANGERS, "strangers", refused)

    def _cancel(self, on_cancel: Callable[[Sequence[bytes]], None], sample: zenoh.Sample) -> None:
        self._counters.add("cancellations")
        try:
            ids = frame.decode_cancel(sample.payload.to_bytes())
        except frame.FrameError as error:
            self._count("malformed", "request_malformed", error)
            return
        if self._chores.qsize() < _CHORES_LIMIT:
            self._chores.put(partial(on_cancel, ids))

    def _heard_records(self, query: zenoh.Query, turn: int) -> None:
        self._counters.add("records")
        attachment = query.attachment
        try:
            greeting = frame.decode_greeting(attachment.to_bytes() if attachment else b"")
            offered = record_frames.unpack(query.payload.to_bytes() if query.payload else b"")
        except (frame.FrameError, RecordError) as error:
            self._malformed(error, query, turn)
            return
        self._do_later(partial(self._take_records, greeting, offered, query, turn), query, turn)

    def _malformed(self, error: ValueError, query: zenoh.Query, turn: int) -> None:
        self._count("malformed", "request_malformed", error)
        refused = Reply(query, _NO_REQUEST, b"", Refusal.MALFORMED, turn=turn)
        self._queues.put(_STRANGERS, "strangers", refused)

    def _count(self, event: str, message: str, reason: object) -> None:
        count = self._counters.add(event)
        if worth_logging(count):
            log.warning("%s reason=%r count=%d", message, str(reason), count)

    # -- the probe thread -----------------------------------------------------------------

    def _take_records(
        self, greeting: frame.Greeting, offered: list[SignedRecord], query: zenoh.Query, turn: int
    ) -> None:
        """Judge records by their own signatures: whoever brings them has no say in them."""
        if not self._greeted(greeting, query, turn):
            return
        try:
            for one in offered:
                verdict = self._records.offer(one)
                if verdict is Verdict.REFUSED:
                    self._counters.add("records_refused")
                    log.warning("record_refused reason=%r", self._records.last_refusal)
                elif verdict is Verdict.OLDER:
                    self._counters.add("records_older")
            query.reply(query.key_expr, b"")
        finally:
            self._end_aside(greeting, query, turn)
        self.revoke(self._records.revoked)

    def _answer_probe(
        self,
        on_probe: Callable[[Probe], ProbeAnswer],
        probe: Probe,
        greeting: frame.Greeting,
        query: zenoh.Query,
        turn: int,
    ) -> None:
        if not self._greeted(greeting, query, turn):
            return
        try:
            answer = replace(on_probe(probe), accepts=ACCEPTED)
            content = probe_frames.encode_probe_answer(answer)
            query.reply(query.key_expr, content, express=True)
        finally:
            self._end_aside(greeting, query, turn)

    def _greeted(self, greeting: frame.Greeting, query: zenoh.Query, turn: int) -> bool:
        """Whether this is somebody who is let in; else it is told why not."""
        try:
            self._guests.greet(greeting)
        except NotAdmittedError as error:
            self._turn_away(Reply(query, _NO_REQUEST, b"", error.refusal, turn=turn), str(error))
            return False
        return True

    def _end_aside(self, greeting: frame.Greeting, query: zenoh.Query, turn: int) -> None:
        """End a query in its robot's own thread: unlike the answer, that queues behind replies."""
        ended = Reply(query, _NO_REQUEST, b"", "", turn=turn, ends_only=True)
        self._queues.put(greeting.token, "probe", ended)

    def _do_chores(self) -> None:
        while (chore := self._chores.get()) is not None:
            try:
                chore()
            except Exception:
                self._counters.add("failed")
                log.exception("probe_not_answered")

    # -- the owner ------------------------------------------------------------------------

    def revoke(self, names: Collection[str]) -> None:
        """Let these holders in no more; what they ask from now on is refused."""
        self._guests.revoke(names)

    def counters(self) -> Mapping[str, int]:
        """Counts since the start: ``requests``, ``probes``, ``replies``, ``refused``,
        ``malformed``, ``records``, ``records_refused``, ``records_older``, ``not_admitted``,
        ``handshakes_refused``, ``unauthenticated``, ``revoked_links``, ``stuck_links``,
        ``reply_dropped``, ``failed``, ``cancellations``, ``chores_dropped``.
        """
        return self._counters.snapshot()

    def close(self) -> None:
        """Send what is queued, then stop. Repeatable; takes a second at most."""
        session, self._session = self._session, None
        if session is None:
            return
        self._declared.clear()
        self._streams.clear()
        if self._doorkeeper is not None:
            self._doorkeeper.close()
        self._queues.close(_CLOSE_WAIT_S / 2)
        sockets.abort_all(self._port, _CLOSE_WAIT_S / 2)
        self._chores.put(None)
        closer = threading.Thread(
            target=_close, args=(session,), name="fogft-close-listener", daemon=True
        )
        closer.start()
        see_off(closer)
        closer.join(_CLOSE_WAIT_S / 2)


def _close(session: zenoh.Session) -> None:
    try:
        session.close()  # type: ignore[no-untyped-call]
    except zenoh.ZError as error:  # a robot is frozen with replies in flight; Zenoh waits 10 s
        log.debug("session_closed_late reason=%r", str(error))


def _with_port(listen: str) -> str:
    host, separator, port = listen.rpartition(":")
    if not separator or not host or not port.isdigit() or int(port) > 65535:
        raise WireError(f"`{listen}` is not `host:port`", "for instance `0.0.0.0:7447`")
    if int(port) != 0:
        return listen
    # Zenoh does not tell which port it was given, so we ask the kernel for a free one first.
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.bind((host.strip("[]"), 0))
            return f"{host}:{probe.getsockname()[1]}"
    except OSError as error:
        raise WireError(f"cannot listen at `{listen}`: {error.strerror or error}") from error
