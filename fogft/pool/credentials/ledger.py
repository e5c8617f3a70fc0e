"""The certificates that a pool's CA has issued and revoked.

They are listed in ``issued.json`` beside the CA, under a lock. A certificate is listed on disk
before it leaves this module, so no valid certificate is missing, and no generation of a name is
used twice. If the list cannot be written, nothing is issued, and `StateError` is raised; a name
that cannot be certified raises `CredentialError`.
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from fogft import disk
from fogft.errors import CredentialError
from fogft.model.credentials import Holder, Role, holder_of
from fogft.model.groups import FIRST_BY_HAND
from fogft.model.plain import Line, Moment, to_plain
from fogft.model.replica import ReplicaId
from fogft.pool.credentials import authority
from fogft.pool.credentials.authority import Credential

_DAY_S = 86_400.0
_WAY_OUT = "without it, revocations are lost; recreate the pool with `fogft down`, then `fogft up`"


@dataclass(frozen=True)
class Entry:
    """One certificate. Times in seconds since the epoch."""

    common_name: Annotated[str, holder_of]
    serial: Line
    issued_at: Moment
    not_after: Moment
    revoked_at: Moment | None = None

    @property
    def holder(self) -> Holder:
        """The holder that it names."""
        return holder_of(self.common_name)

    def state(self, now: float) -> str:
        """Return ``revoked``, ``expired`` or ``good``."""
        if self.revoked_at is not None:
            return "revoked"
        return "expired" if now >= self.not_after else "good"


@dataclass(frozen=True)
class _Issued:
    issued: tuple[Entry, ...]


def _replica(holder: Holder) -> ReplicaId:
    return ReplicaId(holder.pool_uid, int(holder.name), holder.generation)


class Ledger:
    """A pool's list of certificates. Safe to use from several processes."""

    def __init__(self, folder: Path, clock: Callable[[], float] = time.time) -> None:
        self.path = folder / "issued.json"
        self._folder = folder
        self._lock = folder / "issued.lock"
        self._clock = clock
        self._read: tuple[object, tuple[Entry, ...]] = None, ()  # version and content of the file

    def entries(self) -> tuple[Entry, ...]:
        """Return all certificates, oldest first."""
        version, (known, entries) = disk.version(self.path), self._read
        if version is None or version != known:
            found = disk.read_as(_Issued, self.path, _WAY_OUT)
            entries = () if found is None else found.issued
            self._read = version, entries
        return entries

    def revoked(self) -> frozenset[str]:
        """Return the revoked common names."""
        return frozenset(e.common_name for e in self.entries() if e.revoked_at is not None)

    def by_hand(self) -> frozenset[ReplicaId]:
        """Return the manually started replicas with valid certificates."""
        good = map(_replica, self._good(Role.REPLICA))
        return frozenset(id for id in good if id.slot >= FIRST_BY_HAND)

    def due(self, now: float) -> frozenset[ReplicaId]:
        """Return the replicas whose certificates expire soon, and new ones would not."""
        soon = now + authority.RENEW_BEFORE.total_seconds()
        last = {e.common_name: e for e in self.entries()}  # a stopped machine has several
        due = [e.holder for e in last.values() if e.state(soon) == "expired"]
        found = frozenset(_replica(holder) for holder in due if holder.role is Role.REPLICA)
        ca = self._folder / authority.AUTHORITY_CERTIFICATE
        if found and authority.describe(ca).not_after.timestamp() <= soon:
            return frozenset()
        return found

    def gateways(self) -> dict[str, tuple[int, ...]]:
        """Return the generations of each gateway's valid certificates, by name."""
        found: dict[str, tuple[int, ...]] = {}
        for holder in self._good(Role.GATEWAY):
            found[holder.name] = (*found.get(holder.name, ()), holder.generation)
        return found

    def _good(self, role: Role) -> list[Holder]:
        good = (e.holder for e in self.entries() if e.state(self._clock()) == "good")
        return [holder for holder in good if holder.role is role]

    def issue(self, holder: Holder) -> Credential:
        """Certify a holder, and record it."""
        with disk.locked(self._lock):
            return self._issue(holder, self.entries())

    def issue_next(self, role: Role, name: str, pool_uid: str) -> tuple[Holder, Credential]:
        """Certify the next generation of a name, and record it."""
        with disk.locked(self._lock):
            entries = self.entries()
            holders = (e.holder for e in entries)
            used = (h.generation for h in holders if (h.role, h.name) == (role, name))
            holder = Holder(role, name, max(used, default=0) + 1, pool_uid)
            try:
                holder_of(holder.common_name)
            except ValueError:
                raise CredentialError(
                    f"a {role.value} cannot be named `{name}`",
                    "use a slot's number"
                    if role is Role.REPLICA
                    else "use letters, digits and dashes, 28 at most",
                ) from None
            return holder, self._issue(holder, entries)

    def _issue(self, holder: Holder, entries: tuple[Entry, ...]) -> Credential:
        if any(e.common_name == holder.common_name and e.revoked_at for e in entries):
            raise CredentialError(
                f"the certificate of {holder.role.value} `{holder.short}` is revoked",
                "`fogft credentials issue` makes its next generation",
            )
        issued = authority.issue(self._folder, holder.common_name, role=holder.role)
        said = authority.describe_pem(issued.certificate_pem)
        entry = Entry(holder.common_name, said.serial, self._clock(), said.not_after.timestamp())
        self._write((*self._kept(entries), entry))
        return issued

    def revoke(self, holders: Iterable[Holder]) -> None:
        """Revoke certificates permanently. Repeatable."""
        names, now = {holder.common_name for holder in holders}, self._clock()
        with disk.locked(self._lock):
            self._write(
                replace(e, revoked_at=now) if e.common_name in names and e.revoked_at is None else e
                for e in self.entries()
            )

    def named(self, role: Role, name: str) -> list[Holder]:
        """Return the holders of a role with this ``name`` or ``name.generation``."""
        holders = list(dict.fromkeys(e.holder for e in self.entries() if e.revoked_at is None))
        found = [h for h in holders if h.role is role and name in (h.name, h.short)]
        if not found:
            known = ", ".join(f"`{h.short}`" for h in holders if h.role is role) or "none"
            raise CredentialError(
                f"there is no certificate of {role.value} `{name}` to revoke",
                f"valid certificates of this role: {known}",
            )
        return found

    def _kept(self, entries: Iterable[Entry]) -> list[Entry]:
        """Return the entries to keep: valid or revoked ones, and each name's last generation."""
        now = self._clock()
        last = {(e.holder.role, e.holder.name): e for e in entries}
        return [
            e
            for e in entries
            if e.revoked_at or now < e.not_after + _DAY_S or last[e.holder.role, e.holder.name] is e
        ]

    def _write(self, entries: Iterable[Entry]) -> None:
        disk.write_json(self.path, to_plain(_Issued(tuple(entries))))
