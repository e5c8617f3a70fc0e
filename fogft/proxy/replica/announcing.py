"""A replica's exchange with the rendezvous: its own record, and the members it learns.

Owns: the replica's record, when it is written anew, and the doors that it dials.
Not here: what is told with each probe (`server`), records (`fogft.records.record`).
"""

from __future__ import annotations

import logging
from dataclasses import replace

from fogft.link.dial_out.replica import DialOut
from fogft.model.plain import to_plain
from fogft.model.proxy_config import ServerProxyConfig
from fogft.model.replica import ReplicaId
from fogft.records.client import Known, RendezvousClient
from fogft.records.record import RecordError, RecordKind
from fogft.records.roster import SlotState, dial_in
from fogft.records.signing import Signer

log = logging.getLogger(__name__)

_NOTHING = Known()


class Announcer:
    """Keeps one replica's record current: its endpoint, or that it dials out.

    Args:
        endpoint: ``host:port`` as it was told; empty if it was not.
        dials_out: It cannot be reached.
    """

    def __init__(
        self,
        id: ReplicaId,
        records: RendezvousClient,
        *,
        endpoint: str,
        port: int,
        dials_out: bool,
    ) -> None:
        self._id = id
        self._records = records
        self._fixed = SlotState(endpoint=endpoint, dials_out=dials_out)
        self._port = port
        self._said: SlotState | None = None

    def look(self, ready: frozenset[str], *, draining: bool) -> bool:
        """Publish changes; return whether there were any."""
        seen = self._records.known.seen_host
        host = f"[{seen}]" if ":" in seen else seen
        state = replace(
            self._fixed,
            observed_endpoint=f"{host}:{self._port}" if host else "",
            services=tuple(sorted(ready)),
            draining=draining,
        )
        if state == self._said:
            return False
        self._said = state
        self._records.publish(
            RecordKind.SLOT, str(self._id.slot), self._id.generation, to_plain(state)
        )
        return True


class Presence:
    """A replica's connections to the rendezvous and to dial-in ports.

    Args:
        listening: ``host:port`` of its own listener.

    Raises:
        CredentialError: The credentials cannot be used.
    """

    def __init__(self, config: ServerProxyConfig, listening: str) -> None:
        ours = config.credentials
        self._own_doors = config.dial_out
        self._seen: Known | None = None
        self._client: RendezvousClient | None = None
        self._announcer: Announcer | None = None
        self._dial_out: DialOut | None = None
        if config.rendezvous:
            self._client = RendezvousClient(
                config.rendezvous, ours, config.id.pool_uid, cache=config.records
            )
            self._announcer = Announcer(
                config.id,
                self._client,
                endpoint=config.advertise,
                port=int(listening.rpartition(":")[2]),
                dials_out=bool(config.dial_out),
            )
            self._client.start()
        if config.dial_out:
            sign = Signer(ours.certificate, ours.key)
            self._dial_out = DialOut(listening, config.id.pool_uid, sign)
            self._dial_out.follow(config.dial_out)

    def look(self, ready: frozenset[str], *, draining: bool) -> Known:
        """Publish changes, dial new dial-in ports; return the known records."""
        if self._client is None or self._announcer is None:
            return _NOTHING
        self._announcer.look(ready, draining=draining)
        known = self._client.known
        if known is not self._seen:
            self._seen = known
            if self._dial_out is not None:
                self._dial_out.follow((*self._own_doors, *doors(known)))
        return known

    def close(self) -> None:
        """Disconnect."""
        if self._dial_out is not None:
            self._dial_out.close()
        if self._client is not None:
            self._client.close()


def doors(known: Known) -> list[str]:
    """Return where robots and gateways let replicas dial in."""
    found = []
    for record in (*known.of(RecordKind.GATEWAY), *known.of(RecordKind.ROBOT)):
        try:
            found.append(dial_in(record))
        except RecordError as error:
            log.warning("record_odd key=%s reason=%r", record.key, str(error))
    return [door for door in found if door]
