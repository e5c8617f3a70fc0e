"""What all links of one robot share: its credentials, Zenoh's times, what replicas are told."""

from __future__ import annotations

from dataclasses import dataclass, field

from fogft.link.large_send_gate import LargeSendGate
from fogft.link.port import DEFAULT_OPTIONS, SendOptions
from fogft.link.zenoh.settings import LinkSettings
from fogft.model.credentials import CredentialPaths
from fogft.records.signing import Signer


@dataclass
class Shared:
    """What all links of one robot share. `newer`: by slot, what a replica said of old records."""

    credentials: CredentialPaths
    robot: str
    suspect_after_s: float
    settings: LinkSettings
    tell_losers: bool
    options: SendOptions = DEFAULT_OPTIONS
    gate: LargeSendGate = field(default_factory=LargeSendGate)
    records: bytes = b""
    newer: dict[int, bytes] = field(default_factory=dict)
    _signer: Signer | None = None

    @property
    def signer(self) -> Signer:
        """The robot's key, read once. Raises CredentialError where it cannot be used."""
        if self._signer is None:
            self._signer = Signer(self.credentials.certificate, self.credentials.key)
        return self._signer
