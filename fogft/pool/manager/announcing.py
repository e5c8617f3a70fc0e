"""What the manager tells the rendezvous: whom it admits, and whose certificates it took back.

The same membership goes to the client proxy of this machine as a file, and to everybody else
as signed records. Without a rendezvous in the pool file only what was taken back is signed, for
the client proxy to pass on.

Owns: the manager's certificate for signing, and its record client.
Not here: what the membership is (`reconciler`).
"""

from __future__ import annotations

import datetime

from fogft.errors import CredentialError
from fogft.model import names
from fogft.model.credentials import CredentialPaths, holder_of
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Membership
from fogft.pool.credentials import authority
from fogft.pool.credentials.ledger import Ledger
from fogft.pool.folder.paths import PoolPaths
from fogft.records import cache
from fogft.records.client import RendezvousClient
from fogft.records.record import Record, RecordKind, sign_record
from fogft.records.roster import admission_content
from fogft.records.signing import Signer

CERTIFICATE_DAYS = 365.0
RENEW_BEFORE = datetime.timedelta(days=60)
_CERTIFY_EVERY = datetime.timedelta(hours=1)
_STEM = "manager"


class ManagerRecords:
    """Publishes one pool's membership.

    Args:
        paths: The pool's folder.
        pool_uid: Its uid.
        epoch: Of the active manager.
    """

    def __init__(self, paths: PoolPaths, pool_uid: str, epoch: int) -> None:
        self._paths = paths
        self._pool_uid = pool_uid
        self._epoch = epoch
        self._endpoints: tuple[str, ...] = ()
        self._client: RendezvousClient | None = None
        self._certified_at: datetime.datetime | None = None
        self._said: Membership | None = None
        self._revoked: frozenset[str] = frozenset()
        self._signed = b""  # that, as it was written last

    def look(self, endpoints: tuple[str, ...], membership: Membership | None) -> None:
        """Publish what is new, to these rendezvous.

        Raises:
            CredentialError: The pool's CA cannot be used.
            StateError: The manager's certificate cannot be written.
        """
        if membership is not None:
            self._write_revocations(membership.revoked)
        if endpoints != self._endpoints:
            self.close()
            self._endpoints, self._said = endpoints, None
        if not endpoints:
            return
        self._certify(datetime.datetime.now(datetime.timezone.utc))
        if self._client is None:
            self._client = RendezvousClient(
                endpoints, self._files(), self._pool_uid, cache=self._paths.manager_records
            )
            self._client.start()
        if membership is not None and membership != self._said:
            self._say(self._client, membership)
            self._said = membership

    def revocations(self) -> bytes:
        """Return what was taken back up to now, signed, for a launch; empty where nothing was.

        Raises:
            CredentialError: The pool's CA cannot be used.
            StateError: The list of certificates is damaged, or the result cannot be written.
        """
        self._write_revocations(Ledger(self._paths.credentials).revoked())
        return self._signed

    def _write_revocations(self, more: frozenset[str]) -> None:
        """Sign what was taken back, for the client proxy to pass on: there may be no rendezvous."""
        revoked = self._revoked | more
        if revoked == self._revoked:
            return
        self._certify(datetime.datetime.now(datetime.timezone.utc))
        files = self._files()
        # Revocations only grow, so their number counts the writings of one epoch.
        record = Record(
            self._pool_uid,
            RecordKind.REVOCATION,
            "",
            self._epoch,
            len(revoked),
            {"names": sorted(revoked)},
        )
        signed = sign_record(record, Signer(files.certificate, files.key))
        cache.write(self._paths.revocations, [signed])
        self._revoked, self._signed = revoked, self._paths.revocations.read_bytes()

    def _files(self) -> CredentialPaths:
        folder = self._paths.credentials
        return CredentialPaths(
            folder / authority.AUTHORITY_CERTIFICATE,
            folder / f"{_STEM}.crt",
            folder / f"{_STEM}.key",
        )

    def _say(self, client: RendezvousClient, membership: Membership) -> None:
        client.publish(
            RecordKind.ADMISSION,
            "",
            membership.epoch,
            admission_content(membership),
            sequence=membership.version,
        )
        names_ = {"names": sorted(membership.revoked)}
        client.publish(RecordKind.REVOCATION, "", self._epoch, names_)

    def _certify(self, now: datetime.datetime) -> None:
        if self._certified_at is not None and abs(now - self._certified_at) < _CERTIFY_EVERY:
            return
        certificate = self._paths.credentials / f"{_STEM}.crt"
        try:
            good = not authority.describe(certificate).problem(now + RENEW_BEFORE)
        except CredentialError:
            good = False  # there is none yet, or it is damaged
        if not good:
            holder = holder_of(names.manager_certificate_name(self._pool_uid))
            issued = Ledger(self._paths.credentials).issue(holder, days=CERTIFICATE_DAYS)
            authority.write(issued, self._paths.credentials, _STEM)
        self._certified_at = now

    @property
    def trouble(self) -> Reason | None:
        """Return what is wrong; None when at least one rendezvous is there."""
        if self._client is None or self._client.known.connected:
            return None
        said = self._client.status()["rendezvous"]
        details = "; ".join(str(one["detail"]) for one in said)
        return Reason(Cause.NO_RENDEZVOUS, words=details)

    def close(self) -> None:
        """Leave. Repeatable."""
        client, self._client = self._client, None
        if client is not None:
            client.close()
