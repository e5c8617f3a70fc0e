"""Certificate holders and their roles. Pure.

A certificate's common name identifies its holder: ``role.name.generation.pool``, for
instance ``robot.ada.2.0123456789abcdef``; a replica's name is its slot. Revocation is
permanent: a holder that is admitted again gets the next generation.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from fogft.model.names import POOL_UID_PATTERN

# The longest role, dots, six digits and the uid take 36 of a common name's 64 characters.
NAME_LIMIT = 28
NAME_PATTERN = re.compile(rf"[A-Za-z0-9]([A-Za-z0-9_-]{{0,{NAME_LIMIT - 2}}}[A-Za-z0-9])?")


class Role(str, Enum):
    """The role of a certificate holder."""

    ROBOT = "robot"  # sends requests
    REPLICA = "replica"  # answers requests
    GATEWAY = "gateway"  # answers robots' requests, sends requests to replicas
    RENDEZVOUS = "rendezvous"  # keeps signed records; opens no link
    MANAGER = "manager"  # signs admission, topology and revocations; opens no connection


@dataclass(frozen=True, order=True)
class Holder:
    """The holder that a certificate names."""

    role: Role
    name: str  # for a replica, its slot as text
    generation: int  # from 1; incremented by each key rotation or launch of a slot
    pool_uid: str

    @property
    def common_name(self) -> str:
        """The certificate's common name."""
        return f"{self.role.value}.{self.name}.{self.generation}.{self.pool_uid}"

    @property
    def short(self) -> str:
        """Name and generation, as shown to people: ``ada.2``."""
        return f"{self.name}.{self.generation}"


def manager_of(pool_uid: str) -> Holder:
    """Return the manager that signs a pool's membership."""
    return Holder(Role.MANAGER, "manager", 1, pool_uid)


def holder_of(common_name: str) -> Holder:
    """Read a certificate's common name. Raises ValueError if it is not fogft's."""
    role, _, rest = common_name.partition(".")
    name, generation, uid = rest.split(".") if rest.count(".") == 2 else ("", "", "")
    if (
        role not in {known.value for known in Role}
        or not NAME_PATTERN.fullmatch(name)
        or not re.fullmatch(r"[1-9][0-9]{0,5}", generation, re.ASCII)
        or not POOL_UID_PATTERN.fullmatch(uid)
        or (role == Role.REPLICA.value and not re.fullmatch(r"0|[1-9][0-9]*", name, re.ASCII))
    ):
        raise ValueError(f"not the name of a holder: {common_name!r:.80}")
    return Holder(Role(role), name, int(generation), uid)


@dataclass(frozen=True)
class CredentialPaths:
    """Where a process finds its certificate, its key and the pool's CA."""

    ca: Path
    certificate: Path
    key: Path

    @classmethod
    def of(cls, folder: Path, stem: str) -> CredentialPaths:
        """Return the paths in a folder; `stem` names the certificate and the key."""
        return cls(folder / "ca.crt", folder / f"{stem}.crt", folder / f"{stem}.key")
