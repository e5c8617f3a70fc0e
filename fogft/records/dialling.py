"""Open a connection to a rendezvous, soon after it becomes reachable, and verify it.

A new attempt begins every 0.25 s while earlier ones are still in progress: TCP repeats a lost one
only after 1, 3 and 7 seconds, and an attempt over a slow link takes seconds.

Not here: the exchange of records (`exchange`).
"""

import asyncio
import os
import secrets
import socket
import ssl
from pathlib import Path
from typing import Any

from fogft.errors import CredentialError, WireError
from fogft.model.credentials import CredentialPaths
from fogft.model.names import host_and_port
from fogft.records import frames
from fogft.records.exchange import SILENCE_S, Connection
from fogft.records.server import PURPOSE, binding_of, first_message
from fogft.records.signing import Signer

ATTEMPT_EVERY_S = 0.25
_ATTEMPT_TIMEOUT_S = 3.0
_GREETING_TIMEOUT_S = 5.0


async def connect(
    endpoint: str, credentials: CredentialPaths, signer: Signer, pool_uid: str
) -> tuple[Connection, str]:
    """Return an authenticated connection to a rendezvous, and our address as seen there.

    Raises:
        WireError: It cannot be reached, or it is no rendezvous of our pool.
        RecordError: Its first message is not a challenge.
        OSError: DNS or TLS fails. EOFError, asyncio.TimeoutError: It sends no challenge.
    """
    raw = await _reach(endpoint)
    try:
        greeted = _greet(raw, endpoint, credentials.ca, signer, pool_uid)
        return await asyncio.wait_for(greeted, _GREETING_TIMEOUT_S)
    except BaseException:
        raw.close()
        raise


async def _reach(endpoint: str) -> socket.socket:
    """Return the socket of the first overlapping attempt that completes, or raise its error."""
    attempts: set[asyncio.Task[socket.socket]] = set()
    try:
        while True:
            attempts.add(asyncio.create_task(_attempt(endpoint)))
            done, _ = await asyncio.wait(
                attempts, timeout=ATTEMPT_EVERY_S, return_when=asyncio.FIRST_COMPLETED
            )
            for attempt in done:
                attempts.discard(attempt)
                return attempt.result()  # or raises: the caller reports it and retries
    finally:
        for attempt in attempts:
            attempt.cancel()
        for late in await asyncio.gather(*attempts, return_exceptions=True):
            if isinstance(late, socket.socket):
                late.close()


async def _attempt(endpoint: str) -> socket.socket:
    loop = asyncio.get_running_loop()
    host, port = host_and_port(endpoint)
    found = await asyncio.wait_for(
        loop.getaddrinfo(host, port, type=socket.SOCK_STREAM), _ATTEMPT_TIMEOUT_S
    )
    # A random one of its addresses: the next attempt may take another.
    family, kind, protocol, _, address = secrets.choice(found)
    raw = socket.socket(family, kind, protocol)
    try:
        raw.setblocking(False)
        raw.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        await asyncio.wait_for(loop.sock_connect(raw, address), _ATTEMPT_TIMEOUT_S)
    except BaseException as error:
        raw.close()
        if isinstance(error, asyncio.TimeoutError):
            raise WireError(f"`{endpoint}` does not answer") from None
        if isinstance(error, OSError):
            words = os.strerror(error.errno).lower() if error.errno else str(error)
            raise WireError(f"`{endpoint}`: {words}") from error
        raise
    return raw


async def _greet(
    raw: socket.socket, endpoint: str, ca: Path, signer: Signer, pool_uid: str
) -> tuple[Connection, str]:
    context = client_context(ca)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    reader, writer = await asyncio.open_connection(sock=raw, ssl=context, server_hostname="")
    try:
        binding = _check(writer.get_extra_info("ssl_object"), endpoint, pool_uid)
        unframer = frames.Unframer()
        nonce, seen_host = frames.read_challenge(
            await asyncio.wait_for(first_message(reader, unframer), SILENCE_S)
        )
        proof = frames.proof_bytes(PURPOSE, nonce, binding)
        writer.write(frames.greeting(*signer(proof)))
    except BaseException:
        writer.transport.abort()
        raise
    return Connection(reader, writer, unframer, endpoint), seen_host


def client_context(ca: Path) -> ssl.SSLContext:
    """Return a TLS context that verifies certificates of the pool's CA. Raises CredentialError."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False  # its role and pool are checked, not its host
    try:
        context.load_verify_locations(ca)
    except (OSError, ssl.SSLError):
        raise CredentialError(f"the CA `{ca}` cannot be used") from None
    return context


def _check(link: Any, endpoint: str, pool_uid: str) -> bytes:
    """Check that the peer is a rendezvous of our pool; return what binds our greeting to it."""
    subject = dict(entry for part in link.getpeercert()["subject"] for entry in part)
    name, role = subject.get("commonName", ""), subject.get("organizationalUnitName", "")
    if role != "rendezvous" or not name.endswith(f".{pool_uid}"):
        raise WireError(f"`{endpoint}` has the certificate of `{name}`, not of a rendezvous")
    return binding_of(link.getpeercert(binary_form=True))
