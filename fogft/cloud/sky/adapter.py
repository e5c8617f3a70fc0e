"""Replicas on real clouds: `fogft.cloud.port.Cloud` through SkyPilot. See docs/design/sky.md.

Owns: the order of steps of each call, and the threads that follow launches.
Not here: each step's own module: `task`, `journal`, `following`, `ending`, `presence`, `prices`.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fogft.cloud.port import Audit, Launch
from fogft.cloud.sky import listing, task, wheel
from fogft.cloud.sky.census import Census
from fogft.cloud.sky.ending import Ending
from fogft.cloud.sky.failures import classify
from fogft.cloud.sky.following import Following
from fogft.cloud.sky.installed import InstalledSky
from fogft.cloud.sky.journal import ON_THE_MACHINE, UNDER_WAY, Entry, Journal, Stage
from fogft.cloud.sky.naming import OWNER, cluster_name, label_value, replica_of
from fogft.cloud.sky.presence import Presence
from fogft.cloud.sky.prices import Prices
from fogft.cloud.sky.provider import Provider
from fogft.cloud.sky.sdk import RefusedError
from fogft.cloud.sky.task import refuse_what_cannot_be_honoured
from fogft.disk import write_whole
from fogft.errors import CloudError, CloudUnreachable, NoCapacity, QuotaExceeded, StateError
from fogft.model.reason import Cause
from fogft.model.replica import Machine, Offer, ReplicaId

log = logging.getLogger(__name__)

_LOG_LINES = 1000


def _on_thread(run: Callable[[], None]) -> None:
    threading.Thread(target=run, name="sky", daemon=True).start()


def _each_second(step: Callable[[], bool]) -> None:
    def run() -> None:
        while step():
            time.sleep(1.0)

    _on_thread(run)


class SkyCloud:
    """Real clouds. Implements all of `fogft.cloud.port`.

    Args:
        folder: Where it remembers its launches, for all pools of this user.
        sky: SkyPilot.
        providers: Clouds that can be asked directly.
        owner: Whose machines these are, for their labels.
        base: Folder that relative paths of the pool file start from.
        clock: Seconds since the epoch.
        submit: Runs a function on another thread.
        repeat: Calls a function every so often on another thread, until it returns False.
        sleep: Waits some seconds.
        make_wheel: Puts fogft's wheel into a folder below the one given, and returns that.
    """

    def __init__(
        self,
        folder: Path,
        sky: InstalledSky,
        providers: Sequence[Provider] = (),
        *,
        owner: str,
        base: Path,
        clock: Callable[[], float] = time.time,
        submit: Callable[[Callable[[], None]], object] = _on_thread,
        repeat: Callable[[Callable[[], bool]], object] = _each_second,
        sleep: Callable[[float], object] = time.sleep,
        make_wheel: Callable[[Path], Path] = wheel.make,
    ) -> None:
        self._folder = folder
        self._sky = sky
        self._owner = owner
        self._base = base
        self._clock = clock
        self._repeat = repeat
        self._make_wheel = make_wheel
        by_name = {provider.cloud: provider for provider in providers}
        self.journal = Journal(folder / "launches")
        self._census = Census(by_name, clock, submit)
        self._presence = Presence(sky, self.journal, self._census, clock, submit)
        self._ending = Ending(sky, self.journal, by_name, sleep, clock)
        self._following = Following(
            sky, self.journal, self._ending, clock, on_move=self._presence.forget
        )
        self._prices = Prices(sky, by_name, clock, submit)
        self._lock = threading.Lock()
        self._followed: set[ReplicaId] = set()
        self._closed = threading.Event()

    # -- the port -------------------------------------------------------------------------

    def offers(self, resources: Mapping[str, Any]) -> Sequence[Offer]:
        """See `Cloud`. Of each location the cheapest machine that SkyPilot would choose."""
        refuse_what_cannot_be_honoured({"resources": resources})
        return self._prices.offers(resources)

    def machines(self, pool_uid: str) -> Sequence[Machine]:
        """See `Cloud`. Costs one question to SkyPilot's memory; no cloud is asked, as a rule."""
        entries = self.journal.entries(pool_uid)
        machines = self._presence.machines(pool_uid, entries, self._prices.regions)
        for entry in entries:
            if entry.stage in UNDER_WAY:
                self._follow(entry.id)
        return machines

    def launch(self, order: Launch) -> None:
        """See `Cloud`. Returns when SkyPilot has accepted the order: seconds.

        Raises:
            SpecError: The pool file asks for what cannot be honoured. Nothing was launched.
            CloudError: SkyPilot refuses the task. Nothing was launched.
        """
        made = task.build(
            order,
            task.read(),
            files=self.journal.files(order.id),
            wheel=self._make_wheel(self._folder / "wheels"),
            owner=self._owner,
            base=self._base,
        )
        begun = Entry(order.id, order.placement, order.usd_per_hour, order.spec_hash, self._clock())
        if not self.journal.open(begun, order.files):
            return
        try:
            request = self._sky.launch(made, cluster_name(order.id))
        except RefusedError as error:
            self.journal.close(order.id)
            raise _refusal(error, order) from error
        except CloudUnreachable:
            self._follow(order.id)
            raise
        entry = self.journal.update(order.id, stage=Stage.LAUNCHING, request=request)
        if entry is None or entry.stage is Stage.ENDING:  # ended meanwhile, by another process
            self._ending.end(order.id)
            return
        self._follow(order.id)

    def terminate(self, id: ReplicaId) -> None:
        """See `Cloud`. Returns when SkyPilot, and the provider where it can be asked, agree."""
        self.journal.update(id, stage=Stage.ENDING)
        try:
            self._ending.end(id)
        finally:
            self._presence.forget()
        self.journal.close(id)
        self._census.forget(id)

    def log(self, id: ReplicaId) -> str | None:
        """See `Cloud`. Fetches the end of the log from the machine first; takes seconds."""
        entry = self.journal.get(id)
        name = cluster_name(id)
        told = ""
        if entry is None or entry.stage in ON_THE_MACHINE:
            told = self._sky.job_log(name, entry.job if entry else None, _LOG_LINES)
        if not told and entry is not None:
            told = self._sky.provision_log(name, _LOG_LINES)
        path = self.journal.provision_log(id)
        if told:
            write_whole(path, told, durable=False)
        return str(path) if path.exists() else None

    # -- beyond the port --------------------------------------------------------------------

    def refresh(self, id: ReplicaId) -> None:
        """See `Refreshing`. The provider is asked where it can be: SkyPilot's own refresh waits."""
        self._presence.refresh(id)

    def check(self, clouds: Sequence[str] = ()) -> Mapping[str, str]:
        """See `Accounts`."""
        return self._sky.check(clouds)

    def check_task(self, task: Mapping[str, Any]) -> None:
        """See `Accounts`."""
        refuse_what_cannot_be_honoured(task)

    def unverified(self, cloud: str) -> str:
        """See `Accounts`."""
        return self._census.unverified(cloud)

    def audit(self, pool_uid: str = "") -> Audit:
        """See `fogft.cloud.port.Auditing`. SkyPilot is asked, and each provider that can be.

        Of all pools only those are listed whose machines carry this user's label.
        """
        self._presence.forget()
        uids = {pool_uid} if pool_uid else self._pools()
        listed = (
            machine
            for uid in sorted(uids)
            for machine in self._presence.machines(
                uid, self.journal.entries(uid), self._prices.regions
            )
        )
        machines = {machine.id: machine for machine in listed}
        instances, asked = self._census.everywhere(pool_uid)
        for instance in instances:
            if pool_uid or self._mine(instance.labels):
                machines.setdefault(instance.id, listing.of_instance(instance))
        return Audit(tuple(machines[id] for id in sorted(machines)), asked)

    def close(self) -> None:
        """Stop to follow launches; they go on. Repeatable."""
        self._closed.set()

    def _pools(self) -> set[str]:
        """Return the uids of this user's pools, as the journal and SkyPilot know them."""
        uids = {entry.id.pool_uid for entry in self.journal.entries()}
        for cluster in self._presence.everywhere():
            id = replica_of(cluster.name)
            if id is not None and self._mine(cluster.labels):
                uids.add(id.pool_uid)
        return uids

    def _mine(self, labels: Mapping[str, str]) -> bool:
        return labels.get(OWNER, label_value(self._owner)) == label_value(self._owner)

    # -- launches under way -------------------------------------------------------------------

    def _follow(self, id: ReplicaId) -> None:
        with self._lock:
            if id in self._followed or self._closed.is_set():
                return
            self._followed.add(id)
        self._repeat(lambda: self._step(id))

    def _step(self, id: ReplicaId) -> bool:
        more = True
        try:
            more = not self._closed.is_set() and self._following.step(id)
        except CloudUnreachable as error:
            log.warning("launch_unknown replica=%s reason=%r", id.short, error.message)
        except CloudError as error:  # an answer that no step expects; the limits end it
            log.warning("launch_unclear replica=%s reason=%r", id.short, error.message)
        except StateError:  # the journal cannot be read: `machines` says so to the user
            more = False
        finally:
            if not more:
                self._presence.forget()
                with self._lock:
                    self._followed.discard(id)
        return more


def _refusal(error: RefusedError, order: Launch) -> CloudError:
    failure = classify(error.kind, error.texts)
    where = f"`{order.placement.location}`"
    if failure.cause is Cause.CAPACITY:
        return NoCapacity(f"no capacity in {where}: {failure.words}")
    if failure.cause is Cause.QUOTA:
        return QuotaExceeded(
            f"the account's quota is used up in {where}: {failure.words}",
            "ask the cloud for a higher quota, or name other regions",
        )
    return CloudError(f"SkyPilot refuses to launch in {where}: {failure.words}")
