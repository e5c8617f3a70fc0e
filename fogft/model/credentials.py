"""Where the files of a process's credentials are. Pure: only their names, nothing is read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class CredentialPaths:
    """Where a process finds its certificate, its key and the pool's CA."""

    ca: Path
    certificate: Path
    key: Path
