"""A robot in wrong hands: with its good certificate it is let in, and sends damaged frames."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import zenoh

from fogft.link import batch_frames, frame, probe_frames
from fogft.link.port import Peer, Probe
from fogft.link.zenoh import settings as config
from fogft.link.zenoh.settings import LinkSettings
from fogft.model import names
from fogft.model.credentials import CredentialPaths
from fogft.records.signing import Signer
from tests.fuzz.mutation import damaged
from tests.link.wire_pool import SERVICE, hears, keys, knows, peer, request_id

PROBE = b'{"v":%d,"robot":"eve"}' % frame.VERSION


class Target(NamedTuple):
    """A replica, and the key of a service of its."""

    peer: Peer
    key: str

    @property
    def place(self) -> tuple[str, int]:
        return self.peer.id.pool_uid, self.peer.id.slot


def target(endpoint: str) -> Target:
    """Return the replica of the tests' own pool that listens there."""
    return Target(peer(endpoint), keys(0)[SERVICE])


@contextmanager
def session_at(at: Target, files: CredentialPaths) -> Iterator[zenoh.Session]:
    """A bare session with a replica."""
    settings = config.robot_settings(at.peer, files, LinkSettings())
    session = zenoh.open(config.to_zenoh(settings))
    try:
        yield session
    finally:
        session.close()


def greeting(signer: Signer, at: Target, token: bytes) -> bytes:
    """Return what has a connection let in under a token."""
    signed = signer(frame.greeted_bytes(token, at.peer.certificate_name))
    return frame.encode_greeting(frame.Greeting(token, *signed))


def greets(
    session: zenoh.Session,
    files: CredentialPaths,
    at: Target,
    heard: Any = lambda reply: None,
) -> bytes:
    """Have a robot's bare session let in, which hears answers so; return its token."""
    hears(session, at.key)
    knows(session, at.peer.id.slot, at.peer.id.pool_uid)
    token = bytes(range(8))
    signed = greeting(Signer(files.certificate, files.key), at, token)
    (said,) = session.get(names.slot_key(*at.place, names.PROBE), payload=PROBE, attachment=signed)
    assert said.ok is not None
    bare = frame.encode_greeting(frame.Greeting(token))
    answers = names.slot_key(*at.place, names.ANSWERS)
    at_once = zenoh.ConsolidationMode.NONE
    session.get(answers, heard, attachment=bare, timeout=1e6, consolidation=at_once)
    time.sleep(0.3)
    return token


def sends(
    session: zenoh.Session, token: bytes, dice: random.Random, at: Target
) -> Callable[[], None]:
    """Return what sends one damaged frame: at any key that a replica hears."""
    origin = frame.origin("eve", token)
    header, content = batch_frames.encode_requests(
        [(request_id(1), 1.0, False, b"x"), (request_id(2), 1.0, True, b"y")], origin
    )
    requests = frame.encode_request(request_id(3), 1.0, origin), header
    packed = frame.encode_request(request_id(4), 1.0, origin, packed=True)
    cancel = frame.encode_cancel([request_id(1), request_id(2)])
    bare = frame.encode_greeting(frame.Greeting(token))
    probe = probe_frames.encode_probe(Probe("eve", describe=True))
    asked = [(names.PROBE, probe), (names.RECORDS, b"{}"), (names.ANSWERS, b"")]

    def send() -> None:
        kind = dice.randrange(10)
        if kind < 8:
            to = names.slot_key(*at.place, names.CANCEL) if kind == 0 else at.key
            payload = damaged((cancel if kind == 0 else content,), dice)
            head = dice.choice((*requests, packed))
            attachment = damaged((head,), dice) if kind < 6 else head
            session.put(to, payload, attachment=attachment)
        else:
            hello = damaged((bare,), dice) if kind == 8 else bare
            # Not the last as it should be: who asks for answers anew ends those to himself.
            key, payload = dice.choice(asked[:-1] if token in hello else asked)
            session.get(
                names.slot_key(*at.place, key),
                lambda reply: None,
                payload=damaged((payload,), dice),
                attachment=hello,
                timeout=5.0,
            )

    return send
