"""A replica's exchange with the rendezvous: publishes its own record, and learns others'."""

import logging

from fogft.link.dial_out.replica import DialOut
from fogft.model.plain import to_plain
from fogft.model.proxy_config import ServerProxyConfig
from fogft.records.client import Known, RendezvousClient
from fogft.records.expiry import Expiry
from fogft.records.record import RecordError, RecordKind
from fogft.records.roster import SlotState, dial_in
from fogft.records.signing import Signer

log = logging.getLogger(__name__)


class Presence:
    """A replica's connections to the rendezvous and to dial-in ports.

    `listening`: ``host:port`` of its own listener. Raises CredentialError.
    """

    def __init__(self, config: ServerProxyConfig, listening: str) -> None:
        ours = config.credentials
        self._config = config
        self._expiry = Expiry(ours.certificate)
        self._port = listening.rpartition(":")[2]
        self._said: SlotState | None = None
        self._seen: Known | None = None
        self._client: RendezvousClient | None = None
        self._dial_out: DialOut | None = None
        if config.rendezvous:
            self._client = RendezvousClient(
                config.rendezvous, ours, config.id.pool_uid, cache=config.records
            )
            self._client.start()
        if config.dial_out:
            sign = Signer(ours.certificate, ours.key)
            self._dial_out = DialOut(listening, config.id.pool_uid, sign)
            self._dial_out.follow(config.dial_out)

    def look(self, ready: frozenset[str], *, draining: bool) -> Known:
        """Publish changes, connect to new dial-in ports; return the known records."""
        self._expiry.look()
        if self._client is None:
            return Known()
        known, id = self._client.known, self._config.id
        host = f"[{known.seen_host}]" if ":" in known.seen_host else known.seen_host
        state = SlotState(
            endpoint=self._config.advertise,
            observed_endpoint=f"{host}:{self._port}" if host else "",
            dials_out=bool(self._config.dial_out),
            services=tuple(sorted(ready)),
            draining=draining,
        )
        if state != self._said:
            self._said = state
            self._client.publish(RecordKind.SLOT, str(id.slot), id.generation, to_plain(state))
        if known is not self._seen:
            self._seen = known
            if self._dial_out is not None:
                self._dial_out.follow((*self._config.dial_out, *doors(known)))
        return known

    def close(self) -> None:
        """Disconnect."""
        if self._dial_out is not None:
            self._dial_out.close()
        if self._client is not None:
            self._client.close()


def doors(known: Known) -> list[str]:
    """Return the addresses at which robots and gateways let replicas dial in."""
    found = []
    for record in (*known.of(RecordKind.GATEWAY), *known.of(RecordKind.ROBOT)):
        try:
            found.append(dial_in(record))
        except RecordError as error:
            log.warning("record_odd key=%s reason=%r", record.key, str(error))
    return [door for door in found if door]
