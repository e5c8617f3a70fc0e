"""The membership a client proxy follows: from the manager's file, from records, or both.

The newer one counts. Replicas' own records update their endpoints, and replicas that dial in are
reached through the dial-in port ("door").
"""

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

from fogft import disk
from fogft.errors import FogftError
from fogft.link.dial_out.robot import DialIn
from fogft.model.credentials import Holder, Role, holder_of
from fogft.model.membership import from_dict, is_newer
from fogft.model.proxy_config import ClientProxyConfig
from fogft.model.replica import Member, Membership
from fogft.records import roster
from fogft.records.client import Known, RendezvousClient
from fogft.records.expiry import Expiry
from fogft.records.record import RecordKind, SignedRecord
from fogft.records.record_set import RecordSet
from fogft.records.signing import Signer, Verifier

# Changed records are read at most once a second, in bursts of up to this many: otherwise a replica
# whose record keeps changing its endpoint would be redialled all the time.
_LOOKS = 5.0


class Following:
    """A client proxy's view of the pool's membership. Raises WireError, CredentialError."""

    def __init__(
        self, config: ClientProxyConfig, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._clock = clock
        self._looks, self._looked_at = _LOOKS, clock()
        self._config = config
        self._expiry = Expiry(config.credentials.certificate)
        self._file = disk.Watched(config.membership)
        self._from_file: Membership | None = None
        self._changed = threading.Event()
        self._client: RendezvousClient | None = None
        self.door: DialIn | None = None
        self._signed = RecordSet(config.pool_uid, Verifier(config.credentials.ca, lazy=True))
        self._open_door()
        self._call()

    def apply(self, config: ClientProxyConfig) -> None:
        """Apply a changed configuration.

        Raises WireError: The new dial-in port cannot be opened; then there is none.
        """
        old, self._config = self._config, config
        before, doors = ((c.dial_in, c.dial_in_listen) for c in (old, config))
        if before != doors or (any(doors) and self.door is None):
            if self.door is not None:
                self.door.close()
                self.door = None
            self._open_door()
        same = (old.rendezvous, old.dial_in) == (config.rendezvous, config.dial_in)
        if not same or (config.rendezvous and self._client is None):
            if self._client is not None:
                self._client.close()
                self._client = None
            self._call()

    def _open_door(self) -> None:
        config = self._config
        if config.dial_in or config.dial_in_listen:
            self.door = DialIn(
                config.dial_in_listen or "0.0.0.0:" + config.dial_in.rpartition(":")[2],
                config.pool_uid,
                Verifier(config.credentials.ca),
                revoked=self._revoked,
            )
        self._changed.set()

    def _call(self) -> None:
        config = self._config
        if config.rendezvous:
            self._client = RendezvousClient(
                config.rendezvous,
                config.credentials,
                config.pool_uid,
                cache=config.records,
                changed=self._changed.set,
            )
            self._client.start()
            self.renew()
        self._changed.set()

    def renew(self) -> None:
        """Switch to the certificate that is now in its file."""
        if self._client is not None:
            holder = self.holder()
            kind = RecordKind.GATEWAY if holder.role is Role.GATEWAY else RecordKind.ROBOT
            content = {"dial_in": self._config.dial_in}
            self._client.publish(kind, holder.name, holder.generation, content)

    def look(self) -> Membership | None:
        """Return the membership if it may have changed.

        Raises FogftError or OSError: A file cannot be read, and no record has changed.
        """
        now = self._clock()
        self._looks = min(_LOOKS, self._looks + now - self._looked_at)
        self._looked_at = now
        changed = self._changed.is_set() and self._looks >= 1.0
        if changed:
            self._changed.clear()
            self._looks -= 1.0
        if self._file.changed():
            try:
                self._read()
            except (FogftError, OSError):
                self._file.forget()
                if not changed:
                    raise
            changed = True
        if not changed:
            return None
        try:
            return self._located()
        except (FogftError, OSError):
            self._changed.set()
            raise

    def _located(self) -> Membership | None:
        known = self._known()
        latest = self._from_file
        for record in known.of(RecordKind.ADMISSION):
            admitted = roster.admission(record)
            if is_newer(admitted, latest):
                latest = admitted
        if latest is None:
            return None
        slots = known.of(RecordKind.SLOT)
        located = roster.located(latest, slots) if slots else latest
        gateways = roster.gateways_of(latest, self.holder())
        members = self._reached(located) if gateways is None else gateways
        return replace(located, members=members, revoked=located.revoked | known.revoked)

    def holder(self) -> Holder:
        """Return the holder of the certificate now in its file. Raises CredentialError."""
        ours = self._config.credentials
        return holder_of(Signer(ours.certificate, ours.key).common_name)

    def _read(self) -> None:
        raw = disk.read_json(self._config.membership)
        if raw is not None:
            read = from_dict(raw)
            if read.pool_uid == self._config.pool_uid and is_newer(read, self._from_file):
                self._from_file = read

    def _reached(self, membership: Membership) -> tuple[Member, ...]:
        door = self.door
        if door is None:
            return tuple(m for m in membership.members if m.endpoint)
        door.keep([m.id for m in membership.members if not m.endpoint])
        return tuple(
            m if m.endpoint else replace(m, endpoint=door.local(m.id)) for m in membership.members
        )

    def _known(self) -> Known:
        return self._client.known if self._client is not None else Known()

    def _revoked(self) -> frozenset[str]:
        named = self._from_file.revoked if self._from_file is not None else frozenset()
        return named | self._known().revoked

    def report(self, newer: Iterable[SignedRecord] = ()) -> Mapping[str, Any]:
        """Return the newest known manager epoch, and how certificate, rendezvous and port do.

        Only leases with a valid signature count, so a lying replica has no effect.
        """
        for one in newer:
            self._signed.offer(one)
        leases = [*self._signed.of(RecordKind.LEASE), *self._known().of(RecordKind.LEASE)]
        epoch = max((lease.generation for lease in leases), default=0)
        found: dict[str, Any] = {"manager_epoch": epoch, "certificate_left_s": self._expiry.look()}
        if self._client is not None:
            found["records"] = self._client.status()
        if self.door is not None:
            waiting = {id.short: count for id, count in self.door.waiting().items()}
            found["door"] = {"waiting": waiting, **self.door.counters()}
        return found

    def close(self) -> None:
        """Disconnect from each rendezvous, and close the dial-in port."""
        if self._client is not None:
            self._client.close()
        if self.door is not None:
            self.door.close()
