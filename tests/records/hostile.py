"""What somebody hostile sends to a listening port: bytes, certificates, frames, greetings."""

from __future__ import annotations

import contextlib
import os
import random
import socket
import ssl
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import zenoh

from fogft.link import frame
from fogft.link.dial_out.robot import PURPOSE
from fogft.model import names
from fogft.model.credentials import CredentialPaths
from fogft.model.replica import ReplicaId
from fogft.pool.credentials.authority import Role
from fogft.records import frames
from fogft.records.record import Record as Statement
from fogft.records.record import SignedRecord, sign_record
from fogft.records.signing import Signer
from tests.link.wire_pool import LIMIT_S, POOL_UID, Authority, request_id
from tests.records import certificate_names

HELLO = b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03"  # how a TLS handshake begins
JUNK: dict[str, Callable[[random.Random], bytes]] = {
    "random": lambda dice: dice.randbytes(dice.randint(1, 3000)),
    "http": lambda _: b"GET / HTTP/1.1\r\nHost: x\r\n\r\n",
    "zenoh without tls": lambda _: struct.pack("<H", 12) + b"\x01\x09" + bytes(10),
    "truncated record": lambda dice: HELLO + dice.randbytes(20),
    "oversized record": lambda dice: b"\x16\x03\x03\xff\xff" + dice.randbytes(60_000),
    "wrong version": lambda dice: b"\x16\x09\x09\x00\x10" + dice.randbytes(16),
    "nothing": lambda _: b"",
}


def connect(endpoint: str) -> socket.socket:
    host, _, port = endpoint.rpartition(":")
    return socket.create_connection((host, int(port)), 10.0)


def throw(endpoint: str, junk: bytes) -> None:
    """Send bytes and wait until the other end has hung up."""
    with connect(endpoint) as connection, contextlib.suppress(OSError):
        connection.sendall(junk)
        connection.shutdown(socket.SHUT_WR)
        while connection.recv(4096):
            pass


# -- at a port that speaks TLS ------------------------------------------------------------------


def tls(files: CredentialPaths | None, ca: Path) -> ssl.SSLContext:
    """Return how one with such a certificate, or none, shakes hands."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.load_verify_locations(ca)
    if files is not None:
        context.load_cert_chain(files.certificate, files.key)
    return context


def certificates(authority: Authority, stranger: Authority) -> Iterator[CredentialPaths | None]:
    """None, another pool's, a replica's, a rendezvous's, a manager's, an expired one."""
    yield None
    yield stranger.robot()
    yield authority.replica(1)
    yield authority.issue(certificate_names.rendezvous(POOL_UID, "a"), Role.RENDEZVOUS)
    yield authority.issue(certificate_names.manager(POOL_UID), Role.MANAGER)
    yield authority.issue(certificate_names.robot(POOL_UID, "old"), Role.ROBOT, days=-0.5)


def is_turned_away(endpoint: str, context: ssl.SSLContext) -> None:
    """In TLS 1.3 a client's certificate is judged last: it hears so with its first read."""
    with contextlib.suppress(OSError), connect(endpoint) as raw:
        with context.wrap_socket(raw) as connection:
            connection.settimeout(10.0)
            assert connection.recv(1) == b""


# -- from a robot in wrong hands ----------------------------------------------------------------


Send = Callable[[zenoh.Session, bytes, "bytes | None"], object]


def _published(key: str) -> Send:
    block = zenoh.CongestionControl.BLOCK  # else a busy machine would lose some
    return lambda session, payload, attachment: session.put(
        key, payload, attachment=attachment, congestion_control=block
    )


def _asked(key: str) -> Send:
    # Not read: whether a reply comes early or late does not matter here.
    return lambda session, payload, attachment: session.get(
        key, payload=payload, attachment=attachment, timeout=LIMIT_S
    )


def messages(slot: int, service_key: str) -> Iterator[tuple[Send, bytes, bytes | None]]:
    """Return how, payload and attachment of what cannot be read, on every key there is."""
    probe = _asked(names.slot_key(POOL_UID, slot, names.PROBE))
    cancel = names.slot_key(POOL_UID, slot, names.CANCEL)
    records = _asked(names.slot_key(POOL_UID, slot, names.RECORDS))
    header = frame.encode_request(request_id(1), 5.0, frame.origin("eve", bytes(8)))
    greeting = frame.encode_greeting(frame.Greeting(bytes(8), b"c" * 500, b"s" * 70))
    for content in (header[:10], header + bytes(100), b"\x07" + header[1:], os.urandom(40)):
        yield _published(service_key), b"x", content
    yield _published(service_key), b"x", None
    for content in (None, greeting[:5], b"\x07" + greeting[1:], bytes(5000)):
        yield probe, b'{"v":2,"robot":"eve"}', content
    for payload in (b"", b"{}", b"[" * 5000, b'{"v":9,"robot":"eve"}', bytes(100_000)):
        yield probe, payload, greeting
    for content in (None, b"", greeting[:5], b"\x07" + greeting[1:], bytes(5000)):
        yield _asked(names.slot_key(POOL_UID, slot, names.ANSWERS)), b"", content
    for payload in (b"", b"\x07", bytes(100_000)):
        yield _published(cancel), payload, None
    token = frame.encode_greeting(frame.Greeting(bytes(8)))
    for payload in (b"", b"{}", b'{"v":9,"records":[]}', b'{"v":2,"records":[7]}', bytes(300_000)):
        yield records, payload, token


def signed(files: CredentialPaths, statement: Statement) -> SignedRecord:
    return sign_record(statement, Signer(files.certificate, files.key))


# -- at a door where replicas dial in -----------------------------------------------------------


def come(door: str) -> tuple[socket.socket, bytes]:
    """Return a connection to a door, and the nonce that it wants signed."""
    link = connect(door)
    message = next(iter(frames.Unframer().feed(link.recv(4096))))
    return link, frames.read_challenge(message)[0]


def greet(door: str, files: CredentialPaths, purpose: str = PURPOSE) -> socket.socket:
    """Return a connection on which one has said who it is."""
    link, nonce = come(door)
    proof = frames.proof_bytes(purpose, nonce, POOL_UID.encode())
    link.sendall(frames.greeting(*Signer(files.certificate, files.key)(proof)))
    return link


def impostors(authority: Authority, folder: Path) -> Sequence[tuple[CredentialPaths, str]]:
    """Return who may not come in at a door, and as what each is counted."""
    id = ReplicaId(POOL_UID, 0, 1)
    elsewhere = ReplicaId("f" * 16, 0, 1)
    return (
        (authority.robot(), "greeting_role"),
        (authority.issue(id.certificate_name, Role.ROBOT), "greeting_role"),
        (Authority(folder / "stranger").replica(), "greeting_authority"),
        (
            authority.issue(elsewhere.certificate_name, Role.REPLICA),
            "greeting_pool",
        ),
        (
            authority.issue(id.certificate_name, Role.REPLICA, days=-0.5),
            "greeting_expired",
        ),
    )
