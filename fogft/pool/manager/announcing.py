"""The manager's signed records: membership, revocations and its lease.

If the pool file has no rendezvous, only revocations and the lease are signed, for the client proxy
to pass on.
"""

import datetime
from typing import Any

from fogft import disk
from fogft.model.credentials import CredentialPaths, manager_of
from fogft.model.plain import to_plain
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Membership
from fogft.pool.credentials import authority
from fogft.pool.credentials.ledger import Ledger
from fogft.pool.folder.paths import PoolPaths
from fogft.records import cache
from fogft.records.client import RendezvousClient
from fogft.records.record import Record, RecordKind, sign_record
from fogft.records.roster import ServingLease, admission_content
from fogft.records.signing import Signer

_CERTIFY_EVERY = datetime.timedelta(hours=1)
_STEM = "manager"
_LEASE_EVERY_S = 60.0
_LEASE_SHARE = 0.1  # of a short lease, after which the next one is signed


class ManagerRecords:
    """Publishes one pool's membership."""

    def __init__(self, paths: PoolPaths, pool_uid: str, epoch: int) -> None:
        self._paths = paths
        self._files = CredentialPaths.of(paths.credentials, _STEM)
        self._pool_uid = pool_uid
        self._epoch = epoch
        self._endpoints: tuple[str, ...] = ()
        self._client: RendezvousClient | None = None
        self._certified_at: datetime.datetime | None = None
        self._said: Membership | None = None
        self._said_lease: ServingLease | None = None
        self._revoked: frozenset[str] = frozenset()
        self._lease: ServingLease | None = None
        self._leases = 0  # how many were signed in this epoch
        self._announced: dict[str, Any] = {}  # as signed last
        self._written = self._announced
        self._report = disk.Report(paths.announcements)

    def look(
        self, endpoints: tuple[str, ...], membership: Membership | None, lease: ServingLease
    ) -> None:
        """Publish changes at these rendezvous, and sign and write new announcements."""
        self._announce(self._revoked if membership is None else membership.revoked, lease)
        self._publish(endpoints, membership)
        if self._announced is not self._written:  # last: a rendezvous needs no disk
            self._report.write(self._announced)
            self._written = self._announced

    def _publish(self, endpoints: tuple[str, ...], membership: Membership | None) -> None:
        if endpoints != self._endpoints:
            self.close()
            self._endpoints, self._said, self._said_lease = endpoints, None, None
        if not endpoints:
            return
        self._certify(datetime.datetime.now(datetime.timezone.utc))
        if self._client is None:
            client = RendezvousClient(
                endpoints, self._files, self._pool_uid, cache=self._paths.manager_records
            )
            client.start()
            self._client = client
        if membership is not None and membership != self._said:
            self._client.publish(
                RecordKind.ADMISSION,
                "",
                membership.epoch,
                admission_content(membership),
                sequence=membership.version,
            )
            names = {"names": sorted(membership.revoked)}
            self._client.publish(RecordKind.REVOCATION, "", self._epoch, names)
            self._said = membership
        if self._lease is not None and self._lease is not self._said_lease:
            self._client.publish(RecordKind.LEASE, "", self._epoch, to_plain(self._lease))
            self._said_lease = self._lease

    def announcements(self, lease: ServingLease) -> bytes:
        """Return the signed records for a launch: revocations so far, and a lease."""
        self._announce(Ledger(self._paths.credentials).revoked(), lease)
        return disk.to_json(self._announced).encode()

    def _announce(self, more: frozenset[str], lease: ServingLease) -> None:
        """Sign new records for the client proxy to pass on: there may be no rendezvous."""
        revoked, last = self._revoked | more, self._lease
        pause_s = min(_LEASE_EVERY_S, _LEASE_SHARE * lease.lasts_s)
        if revoked == self._revoked and last is not None and abs(lease.at - last.at) < pause_s:
            return
        self._certify(datetime.datetime.now(datetime.timezone.utc))
        signer = Signer(self._files.certificate, self._files.key)
        self._leases += 1
        records = [self._record(RecordKind.LEASE, self._leases, to_plain(lease))]
        if revoked:  # they only grow in number, so that is their sequence in one epoch
            names = {"names": sorted(revoked)}
            records.append(self._record(RecordKind.REVOCATION, len(revoked), names))
        self._announced = cache.content([sign_record(one, signer) for one in records])
        self._revoked, self._lease = revoked, lease

    def rise(self, epoch: int) -> None:
        """Sign in a later epoch from now on, beginning with the next look."""
        self._epoch, self._lease = epoch, None

    def _record(self, kind: RecordKind, sequence: int, content: dict[str, Any]) -> Record:
        return Record(self._pool_uid, kind, "", self._epoch, sequence, content)

    def _certify(self, now: datetime.datetime) -> None:
        if self._certified_at is not None and abs(now - self._certified_at) < _CERTIFY_EVERY:
            return
        if not authority.is_good(self._files.certificate, now):
            issued = Ledger(self._paths.credentials).issue(manager_of(self._pool_uid))
            authority.write(issued, self._paths.credentials, _STEM)
        self._certified_at = now

    @property
    def newest_epoch(self) -> int:
        """Return the newest manager epoch known to a rendezvous; 0 if none."""
        known = [] if self._client is None else self._client.known.of(RecordKind.LEASE)
        return max((lease.generation for lease in known), default=0)

    @property
    def trouble(self) -> Reason | None:
        """Return the problem; None if at least one rendezvous can be reached."""
        if self._client is None or self._client.known.connected:
            return None
        details = (str(one["detail"]) for one in self._client.status()["rendezvous"])
        return Reason(Cause.NO_RENDEZVOUS, words="; ".join(details))

    def close(self) -> None:
        """Disconnect from the rendezvous. Repeatable."""
        client, self._client = self._client, None
        if client is not None:
            client.close()
