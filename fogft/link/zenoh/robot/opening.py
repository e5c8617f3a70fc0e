"""Opening a link's connections, try after try: how long one may take, and why it failed, in words.

Owns: patience, and how often words are looked for. Not here: trying (`link`), and what plain
TLS says (`diagnosis`).
"""

from __future__ import annotations

import socket

from fogft.link.port import Peer
from fogft.link.zenoh import diagnosis
from fogft.link.zenoh.settings import LinkSettings
from fogft.model.credentials import CredentialPaths

_EXPLAIN_EVERY_S = 5.0
_EXPLAIN_TIMEOUT_S = 0.5
_NEARLY = 0.9  # of a time-out, as it is measured


class Opening:
    """The tries to open one link's connection. Used by one thread."""

    def __init__(self, peer: Peer, settings: LinkSettings) -> None:
        self._peer = peer
        self._settings = settings
        self._timed_out = 0  # tries in a row
        self._was_open = False
        self._explained_at = float("-inf")

    @property
    def timeout_s(self) -> float:
        """How long the next try may take: after two time-outs longer, the replica may be slow."""
        patient = self._timed_out % 3 == 2
        return self._settings.long_open_timeout_s if patient else self._settings.open_timeout_s

    def done(self) -> None:
        """A try was well."""
        self._timed_out = 0
        self._was_open = True

    def failed(self, took_s: float, now: float, credentials: CredentialPaths) -> str:
        """A try was not; return why, or nothing where that was looked for lately."""
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
        return diagnosis.explain(self._peer, credentials, _EXPLAIN_TIMEOUT_S)
