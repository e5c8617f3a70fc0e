"""One Zenoh session from a robot to one replica, used once and then discarded.

A request is published to its service's key; all answers come as the replies to one query, which
stays open as long as the connection. A query per request would cost a third more, and at the
replica its time-out would be sent by the one thread that everything else there needs too.

Calls that can block (`put`, `close`) are made by the sender thread of its attempts, so a peer that
reads nothing affects no other link. Methods that send raise `zenoh.ZError` on a closed session.
"""

import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import zenoh
from zenoh import handlers

from fogft.errors import FrameError, LinkVersionError, WireError
from fogft.link import batch_frames, frame
from fogft.link.credit import LargeSendGate
from fogft.link.port import Answer, Peer, SendOptions
from fogft.link.zenoh import threads
from fogft.link.zenoh.diagnosis import wrong_name
from fogft.link.zenoh.flow_watch import FlowWatch
from fogft.link.zenoh.robot.attempts import Attempts, Callbacks
from fogft.link.zenoh.settings import LinkSettings
from fogft.link.zenoh.sockets import address
from fogft.model import names, refusal
from fogft.model.credentials import CredentialPaths
from fogft.model.plain import as_line
from fogft.model.refusal import Refusal
from fogft.process import on_thread
from fogft.records.signing import Signer


@dataclass
class Shared:
    """State that all links of one robot share. Written by the dialer, read by its links."""

    credentials: CredentialPaths
    robot: str
    suspect_after_s: float
    settings: LinkSettings
    tell_losers: bool
    options: SendOptions = field(default_factory=SendOptions)
    gate: LargeSendGate = field(default_factory=LargeSendGate)
    records: bytes = b""  # signed records for every replica, packed; empty for none
    newer: dict[int, bytes] = field(default_factory=dict)  # slot -> newer ones from its replica

    @cached_property
    def signer(self) -> Signer:
        """Signs with the robot's key. Raises CredentialError: it cannot be used."""
        return Signer(self.credentials.certificate, self.credentials.key)


# NONE, not the default: with AUTO (and LATEST) Zenoh holds replies back until the
# last replica has answered. Tested by tests/link/zenoh/robot/test_first_reply_is_not_held_back.
_AT_ONCE = zenoh.ConsolidationMode.NONE
_ANSWERS_TIMEOUT_S = 1e9  # as long as the connection lasts
_PROBE_TIMEOUT_S = 60.0  # on a slow uplink a probe waits behind large messages
_TELL_RECORDS_TIMEOUT_S = 5.0

_REFUSED = {
    Refusal.REVOKED: "our certificate is revoked",
    Refusal.NOT_ADMITTED: "the replica refuses us: our certificate does not allow requests",
    Refusal.EXPIRED_CERTIFICATE: "our certificate is not valid now, by the replica's clock",
}


class Connection:
    """An open session whose peer has been verified; unusable once `lost_because` is set.

    Raises zenoh.ZError: The peer was not reached. WireError: Another peer was; nothing was sent
    to it. CredentialError: Our own certificate (`certificate`, DER) or key cannot be used.
    """

    def __init__(
        self,
        config: zenoh.Config,
        peer: Peer,
        keys: Mapping[str, str],
        shared: Shared,
        tell: Callbacks,
    ) -> None:
        self._wake = tell.wake
        self._begun = False
        self._token = secrets.token_bytes(frame.TOKEN_BYTES)
        self.certificate, signature = shared.signer(
            frame.greeted_bytes(self._token, peer.certificate_name)
        )
        greeting = frame.Greeting(self._token, self.certificate, signature)
        self._greeting = frame.encode_greeting(greeting)
        self._bare = frame.encode_greeting(frame.Greeting(self._token))
        key = partial(names.slot_key, peer.id.pool_uid, peer.id.slot)
        self._cancel_key, self._answers_key = zenoh.KeyExpr(key(names.CANCEL)), key(names.ANSWERS)
        self.lost_because = ""
        self.told, self.told_at = b"", 0.0  # the records that the replica has taken, and when
        self._session = zenoh.open(config)
        self._get = partial(self._session.get, target=zenoh.QueryTarget.ALL, consolidation=_AT_ONCE)
        # The link's thread must not wait for a stuck peer: a dropped probe counts as unanswered.
        self._ask = partial(self._get, congestion_control=zenoh.CongestionControl.DROP)
        try:
            self._listener = self._session.info.declare_link_events_listener(
                handlers.Callback(self._link_event, indirect=False)
            )
            self.flow = self._check_peer(peer)
            self._publishers = {
                name: self._session.declare_publisher(
                    key, congestion_control=zenoh.CongestionControl.BLOCK
                )
                for name, key in keys.items()
            }
            self.attempts = Attempts(
                self,
                frozenset(keys),
                frame.origin(shared.robot, self._token),
                options=shared.options,
                gate=shared.gate,
                tell_losers=shared.tell_losers,
                tell=tell,
                ended=partial(threads.close_session, self._session),
                name=f"fogft-send-{peer.id.short}",
            )
        except BaseException:
            threads.close_aside(self._session, f"fogft-close-{peer.id.short}")
            raise

    def _check_peer(self, peer: Peer) -> FlowWatch:
        links = self._session.info.links()
        found = {link.auth_identifier for link in links}
        if not found:
            raise WireError(f"`{peer.endpoint}` closed the connection at once")
        for name in found - {peer.certificate_name}:
            raise WireError(wrong_name(name, peer), "another machine has this address now")
        return FlowWatch(address(links[0].src), address(links[0].dst))

    def begin(self) -> bool:
        """Open the query for answers, once the replica has admitted us; return whether it is open.

        Before that, Zenoh must know of the replica's subscribers: earlier messages would be lost.
        """
        if self._begun:
            return True
        for publisher in self._publishers.values():
            if not publisher.matching_status.matching:  # type: ignore[attr-defined]
                return False
        ended = partial(self.lose, "the replica closed the stream of answers")
        answers = handlers.Callback(self._heard, ended, indirect=False)
        self._get(self._answers_key, answers, timeout=_ANSWERS_TIMEOUT_S, attachment=self._bare)
        self._begun = True
        return True

    # -- called by its attempts -----------------------------------------------------------

    def publish(self, service: str, content: bytes, header: bytes) -> None:
        """Send a message to a service. May block while the peer does not read."""
        self._publishers[service].put(content, attachment=header)

    def cancel(self, ids: Sequence[bytes]) -> None:
        """Send cancellations of these requests. May block likewise."""
        self._session.put(
            self._cancel_key,
            frame.encode_cancel(ids),
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def lose(self, because: str) -> None:
        """Note that the connection is lost. Any thread; may be called repeatedly."""
        self.lost_because = self.lost_because or because
        self._wake()

    # -- Zenoh's threads ------------------------------------------------------------------

    def _heard(self, reply: zenoh.Reply) -> None:
        threads.note()
        try:
            stamp, answers, packed = read_reply(reply)
        except FrameError as error:
            self.lose(f"its answers cannot be read: {error}")
            return
        self.attempts.heard(stamp, answers, packed=packed)

    def _link_event(self, event: zenoh.LinkEvent) -> None:
        if event.kind == zenoh.SampleKind.DELETE:
            self.lose("the connection was lost")

    # -- the link's thread ----------------------------------------------------------------

    def alive(self) -> bool:
        """Whether Zenoh still has a link under this session."""
        try:
            return bool(self._session.info.links())
        except zenoh.ZError:
            return False

    def probe(self, key: str, payload: bytes, heard: Callable[[bytes], None]) -> None:
        """Send a probe ahead of all requests; `heard` gets the answer's bytes, if any."""
        unanswered = {key}

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None and not unanswered:
                self.lose("it answers a probe twice")
            elif reply.ok is not None:
                unanswered.clear()
                self._greeting = self._bare  # from now on the replica knows us
                heard(reply.ok.payload.to_bytes())
            elif reply.err is not None:
                self._probe_refused(reply.err.payload.to_bytes())

        self._ask(
            key,
            handlers.Callback(on_reply, indirect=False),
            timeout=_PROBE_TIMEOUT_S,
            payload=payload,
            attachment=self._greeting,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
            express=True,
        )

    def _probe_refused(self, content: bytes) -> None:
        try:
            _, _, said, _ = frame.decode_refusal(content)
        except LinkVersionError as error:
            self.lose(str(error))
            return
        except FrameError:
            return  # Zenoh's own error: a time-out; the link's thread measures the silence
        words = _REFUSED.get(
            refusal.read(said)[0], f"the replica refuses our probes: {as_line(said)}"
        )
        self.lose(words)

    def tell_records(self, key: str, records: bytes, newer: Callable[[bytes], object]) -> None:
        """Send signed records; `newer` gets the replica's records that replace outdated ones."""

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self.told, self.told_at = records, time.monotonic()
                if content := reply.ok.payload.to_bytes():
                    newer(content)

        self._ask(
            key,
            handlers.Callback(on_reply, indirect=False),
            timeout=_TELL_RECORDS_TIMEOUT_S,
            payload=records,
            attachment=self._bare,
            # Not the answers' priority: its end at the replica must not wait for room among them.
            priority=zenoh.Priority.DATA_LOW,
        )

    def close(self) -> None:
        """Close it; open attempts are lost. The sender thread ends the session, within 12 s."""
        self.attempts.close()
        # A large send still in progress is wanted by nobody, and may block for minutes.
        try:
            on_thread(self._end_flow, name="fogft-end-link")
        except OSError:
            self._end_flow()

    def _end_flow(self) -> None:
        attempts = self.attempts
        try:
            self.flow.end_when_safe(lambda: attempts.sending, attempts.awaited)
        finally:
            attempts.end()


def read_reply(reply: zenoh.Reply) -> tuple[bytes, Sequence[Answer], bool]:
    """Return a reply's stamp, answers, and whether they are packed. Raises FrameError."""
    ok = reply.ok
    if ok is None:
        err = reply.err
        content = b"" if err is None else err.payload.to_bytes()
        stamp, id, said, load = frame.decode_refusal(content)
        kind, detail = refusal.read(said)
        return stamp, (Answer(id, refusal=kind, detail=detail, load=load),), False
    attachment = ok.attachment
    if attachment is None:
        raise FrameError("an answer without a header")
    header, payload = attachment.to_bytes(), ok.payload.to_bytes()
    if header[:1] == batch_frames.BATCH:
        return *batch_frames.decode_answers(header, payload), False
    stamp, id, load, packed = frame.decode_answer(header)
    return stamp, (Answer(id, payload, load=load),), packed
