"""Terminate a replica reliably: abort its launch, take it down, and verify that it is gone.

A "down" without an error is not trusted: SkyPilot's list is read again, and the provider is asked
if possible. Machines that SkyPilot has forgotten are terminated through the provider, by label.
"""

import contextlib
import itertools
import logging
from collections.abc import Callable
from dataclasses import dataclass

from fogft.cloud.sky.census import Census
from fogft.cloud.sky.installed import InstalledSky
from fogft.cloud.sky.journal import Journal
from fogft.cloud.sky.naming import cluster_name
from fogft.cloud.sky.sdk import RefusedError
from fogft.errors import CloudError, CloudUnreachable
from fogft.model.replica import ReplicaId

log = logging.getLogger(__name__)

_TRIES = 5
_PAUSE_S = 3.0
_LIMIT_S = 300.0  # no further attempt after this
_ABORTED_CHECKS = 4  # in some 20 s: what a launch has just made may not be listed yet
_HEARD_WITHIN_S = 180.0  # as `following.ASK_LIMIT_S`


@dataclass
class Ending:
    """Terminates replicas and verifies that they are gone."""

    sky: InstalledSky
    journal: Journal
    census: Census
    sleep: Callable[[float], object]
    clock: Callable[[], float]

    def end(self, id: ReplicaId) -> None:
        """Terminate a replica's machine; return when it is gone. CloudUnreachable: it may run."""
        name = cluster_name(id)
        trouble: Exception | None = None
        begun_at = self.clock()
        entry = self.journal.get(id)
        # If SkyPilot may still receive the launch request, require two checks that find nothing.
        heard = entry is None or entry.request or begun_at - entry.launched_at >= _HEARD_WITHIN_S
        enough = 1 if heard else 2
        quiet = 0
        for attempt in itertools.count():
            if attempt:
                if attempt >= _TRIES + enough - 1 or self.clock() - begun_at > _LIMIT_S:
                    break
                self.sleep(_PAUSE_S)
            try:
                for request in self.sky.launches(name):
                    if request.active:
                        self.sky.cancel(request.id)
                        enough = _ABORTED_CHECKS
                self.sky.down(name)
                left = self._left(id, name)
            except (CloudUnreachable, RefusedError) as error:
                trouble = error
                log.warning("end_failed replica=%s reason=%r", id.short, str(error))
                with contextlib.suppress(CloudUnreachable, RefusedError):
                    self._left(id, name)  # the provider may succeed where SkyPilot fails
                continue
            quiet = 0 if left else quiet + 1
            late = self.clock() - begun_at > _LIMIT_S
            listed = enough < _ABORTED_CHECKS and id in self.census.listed
            if quiet >= (1 if late or listed else enough):
                return
            trouble = CloudError(f"still there: {', '.join(left)}")
        raise CloudUnreachable(
            f"`{name}` may still be running: {trouble}",
            f"check with `sky status --refresh {name}`, end it with `sky down {name}`, and search "
            f"the cloud's console for machines with the label `fogft-pool={id.pool_uid}`",
        ) from trouble

    def _left(self, id: ReplicaId, name: str) -> list[str]:
        """Return what still exists; ask the provider to terminate what SkyPilot did not."""
        instances = self.census.of(id, self.journal.get(id))
        # Prefer the provider's list: SkyPilot's refresh queues behind its other requests.
        clusters = self.sky.clusters(name, refresh=instances is None)
        left = [f"cluster {c.name} ({c.state.value})" for c in clusters if c.name == name]
        for instance in instances or ():
            left.append(f"{instance.placement.cloud} instance {instance.key}")
            self.census.terminate(instance)
        return left
