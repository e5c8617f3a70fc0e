"""Time limits for opening a link, and why one cannot be opened, in words. Zenoh reports neither.

After a failure only, connects to the endpoint again with plain TCP and TLS.
"""

import contextlib
import errno
import os
import socket
import ssl
import time
from collections.abc import Iterator
from typing import Any

from fogft.errors import CredentialError
from fogft.link.port import Peer
from fogft.link.zenoh.settings import LinkSettings
from fogft.model.credentials import CredentialPaths
from fogft.model.names import host_and_port
from fogft.model.plain import utc
from fogft.records.dialling import client_context
from fogft.records.expiry import end_of

_EXPIRED = 10  # OpenSSL's X509_V_ERR_CERT_HAS_EXPIRED
_TIMEOUT_S = 0.5  # for each step
_ALERTS = {
    "unknown ca": "our certificate is from a different CA than the replica's",
    "decrypt error": "our certificate is from a different CA than the replica's",
    "certificate expired": "our certificate has expired, by the replica's clock",
    "certificate required": "the replica requires a certificate and we have none",
    "unsupported certificate": "our certificate is not a robot's",
    "bad certificate": "the replica does not accept our certificate",
    "certificate unknown": "the replica does not accept our certificate",
    "wrong version number": "no TLS is spoken there: a login page of this network, or a proxy?",
    "violation of protocol": "the connection was closed before TLS: by a proxy of this network?",
}


def explain(peer: Peer, credentials: CredentialPaths) -> str:
    """Return in words why `peer` cannot be reached."""
    try:
        context = _context(credentials)
    except CredentialError as error:
        return error.message
    try:
        with _tls(peer, context) as link:
            return _after_handshake(link, peer)
    except ssl.SSLError as error:
        return _clock_words(error, peer, credentials) or _tls_words(error)
    except TimeoutError:
        return f"`{peer.endpoint}` does not answer"
    except (OSError, ValueError) as error:
        words = getattr(error, "strerror", None) or str(error)
        return f"`{peer.endpoint}`: {words.lower()}"


@contextlib.contextmanager
def _tls(peer: Peer, context: ssl.SSLContext) -> Iterator[ssl.SSLSocket]:
    """Connect through the peer's interface, as its link does. Raises OSError."""
    host, port = host_and_port(peer.endpoint)
    with contextlib.ExitStack() as ends:
        for family, kind, _, _, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
            raw = ends.enter_context(socket.socket(family, kind))
            raw.settimeout(_TIMEOUT_S)
            if peer.interface:
                raw.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, peer.interface.encode())
            if not (refused := raw.connect_ex(address)):
                yield ends.enter_context(context.wrap_socket(raw))
                return
        raise TimeoutError if refused == errno.EAGAIN else OSError(refused, os.strerror(refused))


def _context(credentials: CredentialPaths) -> ssl.SSLContext:
    context = client_context(credentials.ca)
    try:
        context.load_cert_chain(credentials.certificate, credentials.key)
    except (OSError, ssl.SSLError):
        message = f"`{credentials.certificate}` or its key cannot be used"
        raise CredentialError(message) from None
    return context


def _after_handshake(link: ssl.SSLSocket, peer: Peer) -> str:
    certificate: Any = link.getpeercert() or {}
    subject = dict(entry for part in certificate.get("subject", ()) for entry in part)
    found = subject.get("commonName")
    if found != peer.certificate_name:
        return wrong_name(found, peer)
    # In TLS 1.3 the peer verifies our certificate after our side of the handshake: a rejection
    # comes with the first read. None in time means that it was accepted.
    link.settimeout(0.3)
    with contextlib.suppress(TimeoutError):
        link.recv(1)
    return f"`{peer.endpoint}` accepts TLS but no Zenoh session"


def wrong_name(found: str | None, peer: Peer) -> str:
    """Return the message for a peer that presents another name's certificate."""
    return f"`{peer.endpoint}` has the certificate of `{found}`, not of `{peer.certificate_name}`"


def _clock_words(error: ssl.SSLError, peer: Peer, credentials: CredentialPaths) -> str:
    """Return whose clock is wrong if a certificate was rejected as expired, else ""."""
    now = time.time()
    if isinstance(error, ssl.SSLCertVerificationError):
        if error.verify_code != _EXPIRED:
            return ""
        ends = end_of(_certificate_of(peer, credentials))
        why = judged_here(ends, now) if ends is not None and ends <= now else ""
        return f"the replica's certificate is refused: {why}" if why else ""
    if "certificate expired" not in str(error).lower():
        return ""
    with contextlib.suppress(OSError):
        ends = end_of(credentials.certificate.read_bytes())
        if ends is not None:
            return judged_there(ends, now)
    return ""


def _certificate_of(peer: Peer, credentials: CredentialPaths) -> bytes:
    """Return the certificate (PEM) that an endpoint presents, unverified: only to inspect it."""
    context = _context(credentials)
    context.verify_mode = ssl.CERT_NONE
    with contextlib.suppress(OSError, ValueError):
        with _tls(peer, context) as link:
            der = link.getpeercert(binary_form=True) or b""
            return ssl.DER_cert_to_PEM_cert(der).encode()
    return b""


def _tls_words(error: ssl.SSLError) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        verdict = error.verify_message or str(error)
        return f"the replica's certificate is refused: {verdict}"
    text = str(error).lower()
    for alert, words in _ALERTS.items():
        if alert in text:
            return words
    return f"TLS failed: {error.reason or error}"


def judged_here(ends: float, now: float) -> str:
    """Return why we reject an expired certificate; ``now`` is this machine's clock."""
    return (
        f"it expired at {utc(ends)}, and this machine's clock says {utc(now)}. If "
        "that is right, replace the replica"
    )


def judged_there(ends: float, now: float) -> str:
    """Return why a replica rejects our certificate as expired."""
    valid, clock = f"valid to {utc(ends)}", f"this machine's clock says {utc(now)}"
    if now >= ends:
        return f"our certificate has expired ({valid}, {clock})"
    return (
        "the replica's clock is wrong: it rejects our certificate as expired, but it is "
        f"{valid}; {clock}"
    )


_EXPLAIN_EVERY_S = 5.0
_NEARLY = 0.9  # an attempt that took this share of a time-out has timed out


class Opening:
    """Tracks the attempts to open one link's connection. Used by one thread."""

    def __init__(self, peer: Peer, settings: LinkSettings) -> None:
        self._peer = peer
        self._settings = settings
        self._timed_out = 0  # attempts in a row
        self._was_open = False
        self._explained_at = float("-inf")

    @property
    def timeout_s(self) -> float:
        """Time limit of the next attempt; longer after two time-outs: the replica may be slow."""
        patient = self._timed_out % 3 == 2
        return self._settings.long_open_timeout_s if patient else self._settings.open_timeout_s

    def done(self) -> None:
        """Note that an attempt succeeded."""
        self._timed_out = 0
        self._was_open = True

    def failed(self, took_s: float, now: float, credentials: CredentialPaths) -> str:
        """Note a failed attempt; return the reason, or "" if it was diagnosed recently."""
        self._timed_out = self._timed_out + 1 if took_s >= self.timeout_s * _NEARLY else 0
        interface = self._peer.interface
        if interface and interface not in {name for _, name in socket.if_nameindex()}:
            return f"there is no network interface `{interface}` here"
        if took_s >= self._settings.open_timeout_s * _NEARLY:
            if self._was_open:
                return f"`{self._peer.endpoint}` no longer answers: frozen, cut off or overloaded"
            return f"`{self._peer.endpoint}` does not answer yet"
        if now - self._explained_at < _EXPLAIN_EVERY_S:
            return ""
        self._explained_at = now
        return explain(self._peer, credentials)
