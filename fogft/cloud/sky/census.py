"""Ask the providers which machines exist, because SkyPilot may have lost some.

A machine's absence counts only if the provider has listed it before: the local credentials may
belong to another account than those that SkyPilot, or its remote API server, launches with.
"""

import logging
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from fogft.cloud.sky.journal import Entry
from fogft.cloud.sky.provider import Instance, NotAllowedError, Provider
from fogft.errors import CloudUnreachable
from fogft.model.replica import ReplicaId

log = logging.getLogger(__name__)

EVERY_S = 60.0
NOBODY = "0" * 16  # a nonexistent pool, to test the permission to list


@dataclass
class Census:
    """Machines that providers list with our labels; `submit` runs a function in the background."""

    providers: Mapping[str, Provider]
    clock: Callable[[], float]
    submit: Callable[[Callable[[], None]], object]

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._found: dict[str, Sequence[Instance]] = {}
        self._begun_at: dict[str, float] = {}
        self._refused: dict[str, str] = {}
        self.listed: set[ReplicaId] = set()  # replicas whose machine a provider has ever listed

    def of(self, id: ReplicaId, entry: Entry | None) -> list[Instance] | None:
        """Query a replica's instances now; None if only SkyPilot can tell."""
        if entry is None:  # it may be anywhere
            found, _ = self.everywhere(id.pool_uid)
            return [i for i in found if i.id == id] or None
        provider = self.providers.get(entry.placement.cloud)
        if provider is None:
            return None
        mine = self._ask(provider, [entry.placement.region], id.pool_uid)
        vouched = id in self.listed and self.vouches(provider.cloud)
        return [i for i in mine if i.id == id] if vouched else None

    def terminate(self, instance: Instance) -> None:
        """Request the termination of an instance. Raises CloudUnreachable: it may still run."""
        try:
            self.providers[instance.placement.cloud].terminate(instance)
        except NotAllowedError as error:
            raise CloudUnreachable(f"no permission to end {instance.key}: {error}") from error

    def end_when_shut_down(self, instance: Instance) -> None:
        """Make an instance terminate when it shuts itself down; else its disk still costs money."""
        try:
            self.providers[instance.placement.cloud].end_when_shut_down(instance)
        except (CloudUnreachable, NotAllowedError) as error:
            log.warning("stops_only replica=%s reason=%r", instance.id.short, str(error))

    def vouches(self, cloud: str) -> bool:
        """Whether a cloud's own list is available, as far as known."""
        return cloud in self.providers and cloud not in self._refused

    def latest(self, pool_uid: str, regions: Mapping[str, Iterable[str]]) -> Sequence[Instance]:
        """Return a pool's last census; start a new one if it is old. The first asks all regions."""
        now = self.clock()
        with self._lock:
            begun_at = self._begun_at.get(pool_uid)
            due = begun_at is None or not 0 <= now - begun_at < EVERY_S
            if due:
                self._begun_at[pool_uid] = now
            found = self._found.get(pool_uid, ())
        if due and self.providers:
            where = None if begun_at is None else regions
            self.submit(lambda: self._take(pool_uid, where))
        return found

    def everywhere(self, pool_uid: str) -> tuple[Sequence[Instance], frozenset[str]]:
        """List a pool's (empty: all pools') instances in all regions, and which clouds answered."""
        found = [i for p in self.providers.values() for i in self._ask(p, None, pool_uid)]
        return found, frozenset(cloud for cloud in self.providers if self.vouches(cloud))

    def forget(self, id: ReplicaId) -> None:
        """Remove a replica that is known to be gone from the last census."""
        with self._lock:
            kept = self._found.get(id.pool_uid, ())
            self._found[id.pool_uid] = [i for i in kept if i.id != id]

    def unverified(self, cloud: str) -> str:
        """Return why a cloud's own list is unavailable; empty if it is available. Takes seconds."""
        provider = self.providers.get(cloud)
        if provider is None:
            return (
                f"fogft cannot query `{cloud}` and relies on SkyPilot's list of machines: a "
                "VM whose launch outlives this computer and SkyPilot's API server runs until "
                "`fogft sweep`"
            )
        try:
            self._ask(provider, None, NOBODY)
        except CloudUnreachable as error:
            return f"`{cloud}` cannot list its machines: {error.message}"
        reason = self._refused.get(cloud, "")
        return f"{reason}; fogft relies on SkyPilot's list for `{cloud}`" if reason else ""

    def _take(self, pool_uid: str, regions: Mapping[str, Iterable[str]] | None) -> None:
        found: list[Instance] = []
        for cloud, provider in self.providers.items():
            try:
                where = regions.get(cloud, ()) if regions else None
                found += self._ask(provider, where, pool_uid)
            except CloudUnreachable as error:
                log.warning("census_failed cloud=%s reason=%r", cloud, error.message)
                return
        with self._lock:
            self._found[pool_uid] = found

    def _ask(
        self, provider: Provider, regions: Iterable[str] | None, pool_uid: str
    ) -> Sequence[Instance]:
        try:
            found = provider.instances(regions, pool_uid)
        except NotAllowedError as error:
            if provider.cloud not in self._refused:
                log.warning("census_not_allowed cloud=%s reason=%r", provider.cloud, str(error))
            reason = f"this account has no permission to list machines: {error}"
            self._refused[provider.cloud] = reason
            return []
        self._refused.pop(provider.cloud, None)
        self.listed.update(instance.id for instance in found)
        return found
