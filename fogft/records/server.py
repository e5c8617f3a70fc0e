"""The rendezvous server, which stores and passes on a pool's records.

A caller from outside the pool, or an invalid message, ends the connection and is counted by reason.

Not here: records (`exchange`), the process (`fogft.pool.commands.rendezvous`).
"""

import asyncio
import contextlib
import hashlib
import logging
import secrets
import socket
import ssl
from collections.abc import Mapping
from typing import Any, cast

from fogft import disk
from fogft.counters import Counters
from fogft.errors import CredentialError
from fogft.model.credentials import CredentialPaths
from fogft.records import frames
from fogft.records.accepting import listening, oldest_of_most
from fogft.records.exchange import Connection, Exchange
from fogft.records.record import RecordError, Verify, Writer

log = logging.getLogger(__name__)

CONNECTIONS_LIMIT = 512
HANDSHAKES_LIMIT = 64
GREETING_TIMEOUT_S = 10.0
PURPOSE = "rendezvous"
CALLERS = frozenset({"manager", "robot", "replica", "gateway"})


class RendezvousServer:
    """Listens for callers of one pool; all on the event loop that calls `serve`."""

    def __init__(
        self, listen: str, credentials: CredentialPaths, verify: Verify, exchange: Exchange
    ) -> None:
        self._credentials = credentials
        self._verify = verify
        self._exchange = exchange
        self._counters = Counters()
        self._context: ssl.SSLContext | None = None
        self._version: tuple[int, int, int] | None = None
        self._binding = b""
        self._socket: socket.socket | None = None
        self.endpoint = listen  # ``host:port``, as bound once it is
        self._tasks: set[asyncio.Task[None]] = set()
        self._greeting: dict[asyncio.Task[None], str] = {}  # oldest first, with their hosts

    def bind(self) -> None:
        """Bind the port."""
        self._renew_context()
        self._socket = listening(self.endpoint)
        self._socket.setblocking(False)
        self.endpoint = f"{self.endpoint.rpartition(':')[0]}:{self._socket.getsockname()[1]}"

    async def serve(self) -> None:
        """Accept callers until cancelled; then release the port and close all connections."""
        assert self._socket is not None
        loop = asyncio.get_running_loop()
        try:
            while True:
                try:
                    raw, address = await loop.sock_accept(self._socket)
                except OSError as error:  # out of descriptors: wait for some to come free
                    self._count("accept_failed", str(error))
                    await asyncio.sleep(0.1)
                    continue
                host = str(address[0])
                if len(self._exchange) >= CONNECTIONS_LIMIT:
                    self._count("refused_full", host)
                    raw.close()
                    continue
                if len(self._greeting) >= HANDSHAKES_LIMIT:
                    crowd = oldest_of_most(self._greeting)
                    self._count("greeting_crowded", self._greeting.pop(crowd))
                    crowd.cancel()
                task = loop.create_task(self._attend(raw, host))
                self._greeting[task] = host
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)
                await asyncio.sleep(0)  # `sock_accept` never yields while many are waiting
        finally:
            for task in list(self._tasks):
                task.cancel()
            self._exchange.abort()
            with contextlib.suppress(OSError):
                self._socket.close()

    async def _attend(self, raw: socket.socket, host: str) -> None:
        try:
            try:
                connection = await asyncio.wait_for(self._greet(raw, host), GREETING_TIMEOUT_S)
            finally:
                self._greeting.pop(cast(asyncio.Task[None], asyncio.current_task()), None)
        except RecordError as error:
            self._count(f"greeting_{error.reason}", f"{host}: {error}")
        except asyncio.TimeoutError:
            self._count("greeting_timeout", host)
        except (OSError, EOFError) as error:  # TLS errors are OSErrors
            self._count("tls_failed", f"{host}: {error}")
        else:
            self._counters.add("admitted")
            log.info("caller_admitted name=%s host=%s", connection.name, host)
            await self._exchange.keep(connection)
            log.info("caller_left name=%s host=%s", connection.name, host)

    async def _greet(self, raw: socket.socket, host: str) -> Connection:
        """Do the handshake; return the connection of an authenticated caller."""
        loop = asyncio.get_running_loop()
        self._renew_context()
        binding = self._binding
        reader = asyncio.StreamReader(loop=loop)
        protocol = asyncio.StreamReaderProtocol(reader, loop=loop)
        raw.setblocking(False)
        raw.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            transport, _ = await loop.connect_accepted_socket(
                lambda: protocol, raw, ssl=self._context, ssl_handshake_timeout=GREETING_TIMEOUT_S
            )
        except BaseException:
            raw.close()
            raise
        try:
            nonce = secrets.token_bytes(frames.NONCE_BYTES)
            transport.write(frames.challenge(nonce, host))
            unframer = frames.Unframer(limit=16 << 10)
            message = await first_message(reader, unframer)
            certificate, signature = frames.read_greeting(message)
            caller = self._verify(
                certificate, signature, frames.proof_bytes(PURPOSE, nonce, binding)
            )
            self._check(caller)
        except BaseException:
            transport.abort()
            raise
        writer = asyncio.StreamWriter(transport, protocol, reader, loop)
        unframer.limit = frames.FRAME_LIMIT  # for an authenticated caller
        return Connection(reader, writer, unframer, caller.common_name)

    def _check(self, caller: Writer) -> None:
        if caller.role not in CALLERS or not caller.common_name.endswith(
            f".{self._exchange.records.pool_uid}"
        ):
            raise RecordError("role", f"`{caller.common_name}` may not connect")
        if caller.common_name in self._exchange.records.revoked:
            raise RecordError("revoked", f"the certificate of `{caller.common_name}` is revoked")

    def _renew_context(self) -> None:
        """Load certificate and key; reload them when they were replaced."""
        ours = self._credentials
        try:
            version = disk.version(ours.certificate)
            if version is not None and version == self._version:
                return
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.minimum_version = ssl.TLSVersion.TLSv1_3
            context.num_tickets = 0
            context.load_cert_chain(ours.certificate, ours.key)
            der = ssl.PEM_cert_to_DER_cert(ours.certificate.read_text())
        except (OSError, ValueError) as error:
            if self._context is not None:
                return  # being replaced: the old pair is still good
            raise CredentialError(
                f"`{ours.certificate}` or its key cannot be used",
                "issue the rendezvous a certificate of the pool's CA",
            ) from error
        self._version, self._context = version, context
        self._binding = binding_of(der)

    def _count(self, event: str, detail: str) -> None:
        self._counters.warn(log, event, "caller_refused event=%s detail=%r", event, detail[:200])

    def report(self) -> Mapping[str, Any]:
        """Return the counters, for people."""
        exchange = self._exchange
        return {
            "callers": len(exchange),
            "records": len(exchange.records),
            "port": dict(self._counters.snapshot()),
            "messages": dict(exchange.counts),
            "offered": dict(exchange.records.counts),
        }


def binding_of(certificate: bytes) -> bytes:
    """Return the value that binds a greeting to the rendezvous with this certificate (DER)."""
    return hashlib.sha256(certificate).digest()


async def first_message(reader: asyncio.StreamReader, unframer: frames.Unframer) -> dict[str, Any]:
    """Return the first message; bytes received after it stay in the unframer."""
    while data := await reader.read(16 << 10):
        for message in unframer.feed(data):
            return message
    raise EOFError("the other end left without a greeting")
