"""Where the files of a process's credentials are. Pure: only their names, nothing is read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fogft.model import keys


@dataclass(frozen=True)
class CredentialPaths:
    """Where a process finds its certificate, its key and the pool's CA."""

    ca: Path = keys.key(keys.PATH, "The pool's certificate authority.")
    certificate: Path = keys.key(keys.PATH, "Certificate of this process.")
    key: Path = keys.key(keys.PATH, "Its private key.")
