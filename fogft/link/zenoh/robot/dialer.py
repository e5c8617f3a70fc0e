"""Creates links over Zenoh, and holds the state that all links of a robot share."""

import contextlib
import time
from collections.abc import Mapping, Sequence

from fogft.errors import CredentialError, WireError
from fogft.link.port import LinkEvents, Peer, SendOptions
from fogft.link.zenoh.robot.connection import Shared
from fogft.link.zenoh.robot.link import ZenohLink
from fogft.link.zenoh.settings import LinkSettings
from fogft.model.credentials import CredentialPaths
from fogft.records import frames
from fogft.records.record import RecordError, SignedRecord

_CLOSE_WAIT_S = 3.0


class ZenohDialer:
    """Creates links over Zenoh; see `port.Dialer`. Peers of another pool are refused.

    Probes unanswered for `suspect_after_s` make a link suspect. With `tell_losers`, replicas are
    told which requests are no longer wanted.
    """

    def __init__(
        self,
        credentials: CredentialPaths,
        *,
        robot: str,
        pool_uid: str,
        suspect_after_s: float = 2.0,
        settings: LinkSettings | None = None,
        tell_losers: bool = True,
    ) -> None:
        self._shared = Shared(
            credentials,
            robot,
            suspect_after_s,
            settings or LinkSettings(),
            tell_losers,
        )
        self._pool_uid = pool_uid
        self._links: set[ZenohLink] = set()  # each of its methods is atomic

    def adopt(self, options: SendOptions) -> None:
        """Set the options of services, effective from the next connection."""
        self._shared.options = options

    def dial(self, peer: Peer, services: Mapping[str, str], events: LinkEvents) -> ZenohLink:
        """Start a link; return at once. Raises WireError: the peer belongs to another pool."""
        if peer.id.pool_uid != self._pool_uid:
            raise WireError(f"replica `{peer.id}` belongs to another pool than this robot")
        link = ZenohLink(self._shared, peer, services, events, self._links.discard)
        self._links.add(link)
        return link

    def renew(self) -> None:
        """Reload the credentials from their files, link by link."""
        for link in list(self._links):
            link.renew()

    def tell(self, records: Sequence[SignedRecord]) -> None:
        """Send these records to every replica, with the next probe of each link."""
        self._shared.records = frames.pack(records) if records else b""

    def newer(self) -> list[SignedRecord]:
        """Return newer records that replicas sent in reply; nothing is verified."""
        said: list[SignedRecord] = []
        for slot in list(self._shared.newer):  # each only once: a liar may send many, large ones
            with contextlib.suppress(RecordError):
                said += frames.unpack(self._shared.newer.pop(slot))
        return said

    def certificate(self) -> str:
        """Return the common name of the certificate that every open link uses, else ""."""
        used = {link.certificate for link in list(self._links)} - {b""}
        try:
            signer = self._shared.signer
        except CredentialError:
            return ""
        return signer.common_name if used <= {signer.certificate} else ""

    def close(self) -> None:
        """Close every link, and wait briefly for their threads."""
        links = list(self._links)
        for link in links:
            link.close()
        end = time.monotonic() + _CLOSE_WAIT_S
        for thread in filter(None, [link.thread for link in links]):
            thread.join(max(0.0, end - time.monotonic()))
