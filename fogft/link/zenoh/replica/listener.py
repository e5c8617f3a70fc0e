"""A replica's end of links over Zenoh: receives requests and probes, queues replies per connection.

Zenoh's threads only decode and hand over: each connection's replies have their own thread
(`reply_queue`), and another one answers probes (`control_queries`), ahead of all replies.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import zenoh
from zenoh import handlers

from fogft.counters import Counters
from fogft.errors import FrameError, WireError
from fogft.link import batch_frames, frame
from fogft.link.compression import ASIDE_BYTES, Unpacker
from fogft.link.port import Incoming, Probe, ProbeAnswer
from fogft.link.zenoh import sockets, threads
from fogft.link.zenoh.handshakes import HandshakeLog
from fogft.link.zenoh.replica.connection_reaper import ConnectionReaper
from fogft.link.zenoh.replica.control_queries import ControlQueries
from fogft.link.zenoh.replica.query_ends import QueryEnd
from fogft.link.zenoh.replica.reply_queue import Reply, ReplyQueues, ZenohIncoming
from fogft.link.zenoh.replica.reply_streams import Stream, Streams
from fogft.link.zenoh.replica.sessions import AuthenticatedSessions
from fogft.link.zenoh.settings import LinkSettings, replica_settings, to_zenoh
from fogft.link.zenoh.sockets import Address, address
from fogft.link.zenoh.work_queue import WorkQueue
from fogft.model import names, topic
from fogft.model.credentials import CredentialPaths, Role
from fogft.model.refusal import Refusal
from fogft.model.replica import ReplicaId
from fogft.records.accepting import listening
from fogft.records.record import RecordKind
from fogft.records.record_set import RecordSet
from fogft.records.signing import Verifier

log = logging.getLogger(__name__)

_CLOSE_WAIT_S = 1.0


class ZenohListener:
    """A replica's end of all links: receives requests and probes of robots that its CA admits.

    `listen` is ``host:port``, port 0 for any free one. Raises WireError: malformed or unavailable.
    `handshakes` reports refused ones; None to not count them. `certificate_name` is the common
    name of its certificate, if that is not the replica's.
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
        self.endpoint = _with_port(listen)  # ``host:port`` as bound
        self._port = int(self.endpoint.rpartition(":")[2])
        self._handshakes = handshakes
        self._reaper: ConnectionReaper | None = None
        self._id = id
        self._settings = settings or LinkSettings()
        self._config = replica_settings(self.endpoint, id, credentials, self._settings)
        self._sessions = AuthenticatedSessions(
            id.pool_uid,
            certificate_name or id.certificate_name,
            Verifier(credentials.ca, lazy=True),
        )
        self._counters = Counters()
        self.counters = self._counters.snapshot  # since the start, by event
        self._turn = 0  # counted first by Zenoh's thread
        self.revoke = self._sessions.revoke  # stop admitting these holders
        self._work_queue = WorkQueue("fogft-probes", self._counters)
        self._queues = ReplyQueues(self._counters, later=self._work_queue.add)
        self.refusals = self._queues.refusals.snapshot  # by `Refusal` value
        self._unpacker = Unpacker()
        self._session: zenoh.Session | None = None
        self._declared: list[object] = []
        self._thin: set[str] = set()  # the holders with a slow link
        self.streams = Streams(slow=self._thin.__contains__)
        self._records = RecordSet(id.pool_uid, Verifier(credentials.ca, lazy=True))
        # The manager's newest lease that robots have passed on; None before the first.
        self.lease = partial(self._records.get, RecordKind.LEASE)
        self._control = ControlQueries(
            sessions=self._sessions,
            records=self._records,
            streams=self.streams,
            queues=self._queues,
            work=self._work_queue,
            counters=self._counters,
        )
        # Takes the pool's signed records: given before `serve`, no revoked holder is ever admitted.
        self.take_records = self._control.take
        self._services: dict[str, str] = {}  # key -> service
        self._on_request: Callable[[Incoming], None]

    def serve(
        self,
        services: Mapping[str, str],
        on_request: Callable[[Incoming], None],
        on_probe: Callable[[Probe], ProbeAnswer],
        on_cancel: Callable[[Sequence[bytes]], None] = lambda ids: None,
    ) -> None:
        """Start listening. Callbacks come from Zenoh's threads and must not block.

        `on_cancel` takes the ids of requests whose answers are no longer wanted. It may block
        briefly, which delays only probes. Raises WireError: the port is taken, or the credentials
        cannot be used.
        """
        try:
            session = self._session = zenoh.open(to_zenoh(self._config))
        except zenoh.ZError as error:
            raise WireError(
                f"cannot listen at `{self.endpoint}`: {str(error).split(' at /')[0]}",
                "check that the port is free and that the certificate, its key and the CA exist",
            ) from error
        self._work_queue.start()
        self._reaper = ConnectionReaper(
            self._port,
            self._peers,
            lambda: self._sessions.revoked,
            self._counters,
            thin=self._thin,
            also=self._count_handshakes,
            stuck_after_s=self._settings.stuck_after_s,
        )
        self.add(services)
        self._on_request = on_request
        key = partial(names.slot_key, self._id.pool_uid, self._id.slot)
        self._hear(session, key(names.SERVICES), self._request)
        self._hear(session, key(names.CANCEL), partial(self._cancel, on_cancel))
        self._declare(session, key(names.ANSWERS), self._control.open_answers)
        self._declare(session, key(names.RECORDS), self._control.exchange)
        # Last: a robot that learns that this replica is ready must find every service.
        self._declare(session, key(names.PROBE), partial(self._control.probe, on_probe))

    def add(self, services: Mapping[str, str]) -> None:
        """Serve additional services (name -> key); only after `serve`."""
        self._services.update((key, name) for name, key in services.items())

    def _peers(self) -> dict[Address, str]:
        session = self._session
        links = [] if session is None else session.info.links()
        return {address(link.dst): link.auth_identifier or "" for link in links}

    def _count_handshakes(self) -> None:
        for reason in self._handshakes.refusals() if self._handshakes else ():
            self._counters.warn(
                log, "handshakes_refused", "handshake_refused reason=%r", str(reason)
            )

    def _declare(self, session: zenoh.Session, key: str, asked: Callable[[QueryEnd], None]) -> None:
        def heard(query: zenoh.Query) -> None:
            asked(QueryEnd(query, lambda: self._turn))

        callback = self._callback(f"query at {key}", heard)
        self._declared.append(session.declare_queryable(key, callback, complete=True))

    def _hear(
        self, session: zenoh.Session, key: str, heard: Callable[[zenoh.Sample], None]
    ) -> None:
        callback = self._callback(f"message at {key}", heard)
        self._declared.append(session.declare_subscriber(key, callback))

    def _callback(self, what: str, heard: Callable[[Any], None]) -> Any:
        """Return a callback for Zenoh's thread that never raises: nobody would report it there."""

        def guarded(one: Any) -> None:
            self._turn += 1
            threads.note()
            try:
                heard(one)
            except FrameError as error:
                self._malformed(error)
            except Exception:
                self._counters.add("failed")
                log.exception("not_taken what=%r", what)

        return handlers.Callback(guarded, indirect=False)

    # -- Zenoh's threads ------------------------------------------------------------------

    def _request(self, sample: zenoh.Sample) -> None:
        attachment = sample.attachment
        head = attachment.to_bytes() if attachment else b""
        if head[:1] == batch_frames.BATCH:
            requests = batch_frames.decode_requests(head, sample.payload.to_bytes())
        else:
            requests = [(frame.decode_request(head), sample.payload.to_bytes())]
        self._take_requests(str(sample.key_expr), requests)
        self._counters.add("requests", len(requests))

    def _take_requests(
        self, key: str, requests: Sequence[tuple[frame.RequestHeader, bytes]]
    ) -> None:
        token = requests[0][0].token
        stream = self.streams.of(token)
        holder = self._sessions.of(token)
        if stream is None or holder is None:
            self._counters.warn(
                log, "not_admitted", "robot_not_admitted reason=%r", "it did not greet"
            )
            if stream is not None:
                self._refuse(stream, Refusal.NOT_ADMITTED, *requests)
            return
        service = self._services.get(key)
        if service is None:
            self._refuse(stream, Refusal.NOT_READY, *requests)
            return
        # A robot sends in its own name, whatever the header says; a gateway in any robot's name.
        if holder.role is Role.ROBOT and holder.name != requests[0][0].robot:
            requests = [(one._replace(robot=holder.name), content) for one, content in requests]
        for header, payload in requests:
            # A topic's messages are checked on its own thread, and none may overtake another.
            large = len(payload) > ASIDE_BYTES and not service.startswith(topic.PREFIX)
            if not (header.packed or large):
                self._hand_over(service, header, stream, payload)
                continue
            hand_over = partial(self._hand_over, service, header, stream)
            peer = holder.common_name
            if not self._unpacker.put(peer, payload, hand_over, packed=header.packed):
                self._refuse(stream, Refusal.OVERLOADED, (header, payload))
        stream.seen(requests[0][0].seen)

    def _hand_over(
        self, service: str, header: frame.RequestHeader, stream: Stream, request: bytes | None
    ) -> None:
        if request is None:
            self._malformed("a payload that cannot be decompressed")
            self._refuse(stream, Refusal.MALFORMED, (header, b""))
            return
        incoming = ZenohIncoming(service, header, request, stream, self._queues)
        try:
            self._on_request(incoming)
        except Exception:  # continue with the others in its batch
            self._counters.add("failed")
            log.exception("request_not_taken service=%s", service)
            incoming.refuse(Refusal.LOST)

    def _refuse(
        self, stream: Stream, reason: str, *requests: tuple[frame.RequestHeader, bytes]
    ) -> None:
        for header, _ in requests:
            refusal = Reply(stream, header.request_id, b"", reason)
            self._queues.put(header.token, header.robot, refusal, more=True)

    def _malformed(self, error: ValueError | str) -> None:
        self._counters.warn(log, "malformed", "request_malformed reason=%r", str(error))

    def _cancel(self, on_cancel: Callable[[Sequence[bytes]], None], sample: zenoh.Sample) -> None:
        self._counters.add("cancellations")
        ids = frame.decode_cancel(sample.payload.to_bytes())
        self._work_queue.offer(partial(on_cancel, ids))

    # -- the owner ------------------------------------------------------------------------

    def close(self) -> None:
        """Send queued replies, then stop. Repeatable; takes a second at most."""
        session, self._session = self._session, None
        if session is None:
            return
        self._declared.clear()
        self.streams.clear()
        if self._reaper is not None:
            self._reaper.close()
        self._queues.close(_CLOSE_WAIT_S / 2)
        self._count_handshakes()
        sockets.refuse(self._port)  # else aborted peers reconnect before the session is closed
        sockets.abort_all(self._port, _CLOSE_WAIT_S / 2)
        self._work_queue.close()
        threads.close_aside(session, "fogft-close-listener", _CLOSE_WAIT_S / 2)
        if self._handshakes:  # discard those that Zenoh reports because of our shutdown
            self._handshakes.refusals()


def _with_port(listen: str) -> str:
    host, separator, port = listen.rpartition(":")
    if not separator or not host or not port.isdecimal() or int(port) > 65535:
        raise WireError(f"`{listen}` is not `host:port`", "for instance `0.0.0.0:7448`")
    if int(port) != 0:
        return listen
    # Zenoh does not report the port that it was given, so we ask the kernel for a free one first.
    with listening(listen) as probe:
        return f"{host}:{probe.getsockname()[1]}"
