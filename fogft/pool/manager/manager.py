"""The manager: one process per pool that reconciles once a second or on a change.

SIGTERM ends the manager, never the pool: replicas and the client proxy keep running, and the
next manager takes over what it finds.

Owns: the loop, what wakes it, and the pool's status file.
Not here: a tick's work (`reconciler`), the client proxy's life (`proxy_supervisor`).
"""

import datetime
import logging
import os
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from fogft import __version__, disk, logfile
from fogft.cloud.port import Cloud, Launch, RealCloud
from fogft.errors import FogftError, PoolBusy, PoolNotFound, StateError
from fogft.metrics.scrape import Scrape
from fogft.model.plain import to_plain
from fogft.model.reason import Cause, Reason, because
from fogft.model.replica import LinkReport, LinkState, Offer
from fogft.model.spec import PoolSpec
from fogft.model.topology import LAUNCHED
from fogft.planning import lifetime
from fogft.planning.observed.history import Event, EventKind
from fogft.planning.planner import PlannedLaunch
from fogft.pool.credentials.ledger import Ledger
from fogft.pool.folder.costs import CostBook
from fogft.pool.folder.discovered import Discovery
from fogft.pool.folder.lease import Lease, supersedes
from fogft.pool.folder.paths import latency_file
from fogft.pool.folder.store import Identity, PoolStore
from fogft.pool.manager import (
    configuration,
    proxy_report,
    proxy_supervisor,
    shutdown,
    status,
    teardown,
    timekeeping,
)
from fogft.pool.manager.announcing import ManagerRecords
from fogft.pool.manager.distances import Distances, Latencies
from fogft.pool.manager.launched_gateway import LaunchedGateway
from fogft.pool.manager.proxy_report import ProxyReport
from fogft.pool.manager.proxy_supervisor import ProxySupervisor
from fogft.pool.manager.reconciler import Reconciler, Tick
from fogft.pool.manager.tally import Tally, of_pool
from fogft.process import Watchdog, notify, on_thread, prepared_thread, start_log, stop_on_signal
from fogft.records.roster import ServingLease

log = logging.getLogger(__name__)
T = TypeVar("T")

TICK_S = 1.0
WATCH_S = 0.05
CERTIFY_EVERY_S = 3600.0
RUN_ENDED_S = 300.0  # from the end of `run` to the end of its machine
LEAVE_LIMIT_S = 60.0  # then it is tried again in the next round


@dataclass(eq=False)
class Manager:
    """Manages one pool until told to stop. Holds the pool's lease from the start.

    Args:
        proxy_command: The command to start instead of our own client proxies.
        metrics: ``host:port`` to answer Prometheus at; None for the pool file's.
        keeps_proxy: Whether it starts client proxies; if not, systemd or the user does.
    """

    store: PoolStore
    cloud: Cloud
    _: KW_ONLY
    proxy_command: Sequence[str] | None = None
    metrics: str | None = None
    keeps_proxy: bool = True

    def __post_init__(self) -> None:
        self._paths = self.store.paths
        self._identity = self.store.identity()
        published = self.store.membership()
        first = max(self._identity.first_epoch, published.epoch if published else 0)
        self._lease = Lease(self._paths, at_least=first)
        self._report = disk.Report(self._paths.status)
        self._wake = threading.Event()
        self._proxy = ProxySupervisor(
            self._paths, time.monotonic, self.proxy_command, ended=self._wake.set
        )
        self._ledger = Ledger(self._paths.credentials)
        self._certified_at: float | None = None
        self._certified_for: object = None  # the revocations, and the robot's key
        self._records = ManagerRecords(self._paths, self._identity.uid, self._lease.epoch)
        self._discovery = Discovery(self._paths.discovered)
        self._versions: dict[Path, tuple[int, int, int] | None] = {}
        self._digest: object = None
        self._trouble: list[Reason] = []
        self._told: status.PoolStatus | None = None
        self._tally = Tally()
        self.store.heard = self._tally.heard
        self._scrape = Scrape(
            lambda: of_pool(self._told, self._tally), {"pool": self._identity.name}
        )
        self._replicas: Sequence[status.ReplicaStatus] = ()
        self._costs = CostBook(self._paths.costs, self._identity.name, self._identity.uid)
        self._reconciler = Reconciler(
            self.cloud,
            self.store,
            clock=timekeeping.read,
            links=self._links,
            build_order=self._build_order,
            prepare=prepared_thread,
            epoch=self._lease.epoch,
            ledger=self._ledger,
            gateway=LaunchedGateway(
                self.cloud, self._gateway_up, self._gateway_order, self.store.place_gateway
            ),
            on_done=self._wake.set,
            distances=Distances(Latencies(latency_file())),
        )

    def run(self, stop: threading.Event) -> None:
        """Manage until `stop` is set or the pool's folder is gone."""
        log.info("manager_started pool=%s epoch=%d", self._identity.name, self._lease.epoch)
        try:
            self._attempt(lambda: proxy_supervisor.allow_restart(self._paths))
            watchdog = Watchdog()
            while not stop.is_set():
                if self._work() and self._attempt(self._let_go):
                    break
                notify("READY=1")
                watchdog.work()
                self._rest(stop)
            else:
                proxy_supervisor.forbid_restart(self._paths)
        except PoolNotFound:
            log.info("manager_stopped pool=%s reason=ended", self._identity.name)
        finally:
            self._close()
        log.info("manager_stopped pool=%s", self._identity.name)

    def _close(self) -> None:
        self.store.flush()
        self._scrape.close()
        self._records.close()
        self._lease.release()

    def _let_go(self) -> bool:
        """Stop managing a pool that has ended; return False if `up` has just given it more hours.

        An `up` comes first, or finds no manager: it must not rely on one that is about to stop.
        """
        lock = disk.Lock(self._paths.intent_lock)
        if not lock.acquire(wait=False):
            return False  # a command is changing the pool: look again
        try:
            is_over = lifetime.is_over(self.store.spec(), self._begun_at(), time.time())
            if is_over:
                proxy_supervisor.forbid_restart(self._paths)
                self._close()
            return is_over
        finally:
            lock.release()

    def _work(self) -> bool:
        """Do one round; failed steps are retried in the next. Return whether the pool ended."""
        self._trouble = []
        self.store.flush()
        for step in (self._lease.beat, self._step_back, self._bound_logs, self._keep_proxy):
            self._attempt(step)
        tick = self._attempt(self._reconciler.tick)
        self._attempt(lambda: self._announce(tick))
        if tick is None:
            return False
        self._scrape.at(tick.spec.metrics.manager if self.metrics is None else self.metrics)
        self._attempt(lambda: self._charge(tick))
        self._attempt(lambda: self._discover(tick))
        if tick.over and tick.observed.machines == ():
            self._attempt(self._leave)
            if not self._trouble:
                ended = f"automatically, after {tick.spec.max_hours:g} hours (`max_hours`)"
                self._attempt(lambda: self._write_status(tick, ended))
                return not self._trouble
        self._attempt(lambda: self._write_status(tick))
        return False

    def _step_back(self) -> None:
        """Give up the pool, as an export does, if another machine has taken it over later."""
        report = self._fresh_report(time.time())
        heard = max(self._records.newest_epoch, report.manager_epoch if report else 0)
        if not supersedes(heard, self._lease.epoch):
            if heard > self._lease.epoch:  # our folder is older: replicas would ignore our leases
                log.warning("epoch_was_behind pool=%s heard=%d", self._identity.name, heard)
                self._lease.epoch = self._reconciler.epoch = heard + 1
                self._records.rise(heard + 1)
            return
        log.error("pool_superseded pool=%s epoch=%d", self._identity.name, heard)
        proxy_supervisor.forbid_restart(self._paths)
        with shutdown.without_orders(self._paths, self.store.spec(), lambda _: None):
            os.replace(self._paths.identity, self._paths.exported)
        self.store.identity()  # raises PoolBusy

    def _bound_logs(self) -> None:
        for path in (self._paths.manager_log, self._paths.proxy_log):
            logfile.bound(path)

    def _build_order(self, identity: Identity, spec: PoolSpec, planned: PlannedLaunch) -> Launch:
        return configuration.build_order(self._paths, identity, spec, planned, self._signed(spec))

    def _gateway_order(self, spec: PoolSpec, offer: Offer, generation: int) -> Launch:
        return configuration.gateway_order(
            self._paths, self._identity, spec, offer, generation, signed=self._signed(spec)
        )

    def _signed(self, spec: PoolSpec) -> bytes:
        """Return the signed records for a launch. Raises StateError, OSError: it cannot succeed."""
        on_thread(lambda: None)  # first: each order issues a certificate
        if why := disk.unwritable(self._paths.folder):
            raise StateError(f"the disk of `{self._paths.folder}` is {why}: nothing is launched")
        return self._records.announcements(self._serving_lease(spec))

    def _gateway_up(self, now: float) -> bool:
        report = self._fresh_report(now)
        good = max(self._ledger.gateways().get(LAUNCHED, ()), default=0)
        return report is not None and any(
            (one.name, one.generation, one.state) == (LAUNCHED, good, LinkState.UP)
            for one in report.gateways
        )

    def _announce(self, tick: Tick | None) -> None:
        spec, membership = self.store.spec(), tick.membership if tick is not None else None
        self._records.look(spec.rendezvous, membership, self._serving_lease(spec))

    def _serving_lease(self, spec: PoolSpec) -> ServingLease:
        now, begun_at = time.time(), self._begun_at()
        return ServingLease(now, lifetime.unmanaged_s(spec, begun_at, now))

    def _begun_at(self) -> float:
        history = self.store.history()
        return lifetime.begun_at(self.store.intent(), self.store.identity().created_at, history)

    def _discover(self, tick: Tick) -> None:
        if self._discovery.look(tick.spec, tick.observed, tick.plan.wanted):
            log.info("services_discovered pool=%s", self._identity.name)
            self._wake.set()  # to tell the client proxy

    def _charge(self, tick: Tick) -> None:
        seen = tick.observed
        if seen.machines is not None:
            alone_s = tick.spec.unmanaged_max_hours * lifetime.HOUR_S + RUN_ENDED_S
            self._costs.look(seen, alone_s, self._reconciler.timekeeping.watch.set_s)

    def _leave(self) -> None:
        """Remove everything except the folder of a pool that ends by itself."""

        def done(what: str) -> None:
            log.info("ended pool=%s what=%r", self._identity.name, what)

        with shutdown.without_client_proxy(self._paths, done):
            teardown.end_machines(
                self.cloud,
                self._identity.uid,
                known=teardown.known(self.store),
                done=done,
                warned=lambda what: log.warning("not_verified reason=%r", what),
                limit_s=LEAVE_LIMIT_S,
            )

    def _attempt(self, step: Callable[[], T]) -> T | None:
        try:
            return step()
        except (PoolNotFound, PoolBusy):
            raise
        except (FogftError, OSError) as error:  # disk full, no descriptors, folder gone
            message = error.message if isinstance(error, FogftError) else str(error)
            log.error("manager_step_failed reason=%r", message)
            self._trouble.append(Reason(Cause.TROUBLE, words=message))
            return None

    def _keep_proxy(self) -> None:
        now = time.time()
        seen = self._ledger.revoked(), disk.version(self._paths.credentials / "robot.key")
        due = self._certified_at is None or abs(now - self._certified_at) > CERTIFY_EVERY_S
        if due or seen != self._certified_for:
            utc = datetime.datetime.now(datetime.timezone.utc)
            configuration.certify_robot(self._paths, self._identity, utc)
            self._certified_at, self._certified_for = now, seen
        configuration.write_proxy_config(self._paths, self._identity, self.store.spec())
        over = lifetime.is_over(self.store.spec(), self._begun_at(), time.time())
        if self.keeps_proxy and not self.store.intent().stopping and not over:
            report = self._fresh_report(time.time())
            before = self._proxy.replacements
            self._proxy.look(outdated=report is not None and report.version != __version__)
            if self._proxy.replacements != before:
                self.store.append(Event(now, EventKind.PROXY_REPLACED, 0, 0))

    def _fresh_report(self, now: float) -> ProxyReport | None:
        report = proxy_report.read(self._paths.proxy_status, self._identity.uid)
        return report if report is not None and report.fresh(now) else None

    def _links(self, pool_uid: str, now: float) -> tuple[LinkReport, ...] | None:
        report = self._fresh_report(now)
        return None if report is None else report.links

    def _write_status(self, tick: Tick, ended: str = "") -> None:
        report = proxy_report.read(self._paths.proxy_status, self._identity.uid)
        fresh = report is not None and report.fresh(time.time())
        notes = [
            *self._trouble,
            *self._discovery.notes,
            *because(self._proxy.trouble),
            *because(self._records.trouble),
        ]
        if (report is None or not fresh) and not tick.over:
            cause = Cause.STALE_PROXY_REPORT if report else Cause.NO_PROXY_REPORT
            notes.append(Reason(cause))
        ends_at = self.cloud.credentials_end_at() if isinstance(self.cloud, RealCloud) else None
        seen = replace(
            status.of_tick(tick, self.store.history(), self.store.recent(), notes),
            epoch=self._lease.epoch,
            manager_pid=os.getpid(),
            usd_to_date=self._costs.usd,
            credentials_end_at=ends_at,
        )
        if seen.cloud_reachable:
            self._replicas = seen.replicas
        else:  # show the last known replicas; `cloud_reachable` says that they are old
            seen = replace(seen, replicas=self._replicas)
        seen = seen.joined(report, proxy_alive=fresh, links=tick.observed.links)
        if ended:
            seen = replace(
                seen, ended=ended, proxy_alive=False, proxy_pid=None, notes=[], reasons=[]
            )
            log.info("pool_ended pool=%s how=%r", self._identity.name, ended)
        self._told = seen
        self._tally.seen(seen.replicas, tick.observed.now)
        self._report.write(to_plain(seen))

    def _rest(self, stop: threading.Event) -> None:
        """Wait for the next tick, or for something to react to."""
        end = time.monotonic() + TICK_S
        while time.monotonic() < end and not stop.is_set():
            if self._wake.wait(WATCH_S) or self._something_changed():
                self._wake.clear()
                return

    def _something_changed(self) -> bool:
        paths = self._paths
        before, report_path = self._versions, paths.proxy_status
        watched = (paths.spec, paths.intent, self._ledger.path, report_path)
        self._versions = {path: disk.version(path) for path in watched}
        changed = {path for path in before if self._versions[path] != before[path]}
        if report_path in changed:
            report = proxy_report.read(report_path, self._identity.uid)
            digest = report.digest() if report is not None else None
            if digest != self._digest:
                self._digest = digest
                return True
        return bool(changed - {report_path})


def run(store: PoolStore, cloud_of: Callable[[Identity], Cloud], **how: Any) -> None:
    """Run a pool's manager in this process until a signal ends it, or the pool has ended."""
    start_log()
    stop = stop_on_signal()
    Manager(store, cloud_of(store.identity()), **how).run(stop)
