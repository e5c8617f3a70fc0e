"""The reconciler: observe, plan and apply, each tick from the current state.

Owns: the order of reading and writing within a tick, so that a tick killed at any point leaves
nothing that the next one does not repair.
Not here: the decisions (`fogft.planning.planner`), the loop and the processes (`manager`).
"""

import contextlib
import functools
import json
import logging
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from fogft import logfile
from fogft.cloud.port import Cloud, Launch, RealCloud, Refreshing
from fogft.errors import CloudError, CloudUnreachable, FogftError, NoCapacity, QuotaExceeded, told
from fogft.model.groups import GATEWAY_SLOT, replica_hash, sales, task_at
from fogft.model.intent import Intent
from fogft.model.membership import members_of, successor
from fogft.model.reason import Cause, Reason
from fogft.model.replica import (
    LinkReport,
    Machine,
    MachinePhase,
    Membership,
    Observed,
    Offer,
    ReplicaId,
    by_id,
)
from fogft.model.spec import PoolSpec
from fogft.model.topology import certified
from fogft.planning import lifetime, standbys
from fogft.planning.observed.clock_jumps import LEAST_S, Reading
from fogft.planning.observed.health import judge
from fogft.planning.observed.history import EventKind, History, fault_of
from fogft.planning.observed.refresh import Silent
from fogft.planning.planner import Plan, PlannedLaunch, plan
from fogft.planning.rollout import Update
from fogft.planning.sizing import Inputs, cap_usd
from fogft.pool.credentials.ledger import Ledger
from fogft.pool.folder.store import Identity, PoolStore
from fogft.pool.manager import offers
from fogft.pool.manager.event_recorder import EventRecorder
from fogft.pool.manager.launched_gateway import LaunchedGateway
from fogft.pool.manager.operations import Operations, Prepare
from fogft.pool.manager.timekeeping import Timekeeping
from fogft.pool.manager.updating import Updating
from fogft.reason_words import words

log = logging.getLogger(__name__)

OFFERS_EVERY_S = 30.0
LOG_LINES = 20

Links = Callable[[str, float], "tuple[LinkReport, ...] | None"]
Distances = Callable[[PoolSpec, Observed], Mapping[str, float]]
BuildOrder = Callable[[Identity, PoolSpec, PlannedLaunch], Launch]


class Tick(NamedTuple):
    """The observations and decisions of one tick.

    Attributes:
        over: The pool's `max_hours` have passed: it ends by itself.
        update: The update under way, or the one that was given up; None without one.
    """

    identity: Identity
    spec: PoolSpec
    intent: Intent
    observed: Observed
    plan: Plan
    membership: Membership | None
    over: bool = False
    update: Update | None = None
    file: str = ""


def bare_order(identity: Identity, spec: PoolSpec, planned: PlannedLaunch) -> Launch:
    """Return a launch order without files: enough for a cloud, not for serving."""
    return Launch(
        id=ReplicaId(identity.uid, planned.slot, planned.generation),
        pool=identity.name,
        placement=planned.offer.placement,
        usd_per_hour=planned.offer.usd_per_hour,
        spec_hash=replica_hash(spec, planned.slot),
        task=task_at(spec, planned.slot),
        link_port=spec.link_port,
        dials_out=spec.dials_out,
        allow_from=spec.allow_from,
    )


@dataclass(eq=False)
class Reconciler:
    """Reconciles one pool with its spec; `ledger` has its certificates, `gateway` is to launch."""

    cloud: Cloud
    store: PoolStore
    _: KW_ONLY
    clock: Callable[[], Reading]
    links: Links
    build_order: BuildOrder = bare_order
    prepare: Prepare = lambda run: run
    epoch: int = 1
    ledger: Ledger | None = None
    gateway: LaunchedGateway | None = None
    on_done: Callable[[], None] = lambda: None
    distances: Distances = lambda spec, *_: spec.placement.rtt_s

    def __post_init__(self) -> None:
        self._refreshing = self.cloud if isinstance(self.cloud, Refreshing) else None
        self._stopping = self.cloud if isinstance(self.cloud, RealCloud) else None
        # The machine that is expected of a launch; None for a termination.
        self.operations: Operations[Machine | None] = Operations(self.prepare, self.on_done)
        self._refreshes: Operations[None] = Operations(self.prepare, self.on_done)
        self._silent = Silent()
        self._offers: tuple[Offer, ...] = ()
        self._offers_for: tuple[str, float] | None = None
        self._updating = Updating(self.store)
        self.timekeeping = Timekeeping(self.store, self._updating, self.clock)
        self._recorder = EventRecorder(self.store, lambda: self.timekeeping.now)
        self._membership: Membership | None = self.store.membership()
        self._published_for: tuple[Any, ...] | None = None  # its inputs
        self._log_tail = ""  # of the last replica that was ended because it was never ready

    def tick(self) -> Tick:
        """Observe, plan and apply once.

        Raises:
            StateError: A file cannot be read, or written before the plan is applied.
        """
        if self.timekeeping.look():  # first: `renewed` relies on all else being observed later
            self._silent = Silent()
        identity, spec, intent = self.store.identity(), self.store.spec(), self.store.intent()
        history = self.store.history()
        self._settle_outcomes()
        observed, trouble = self._observe(identity, spec)
        asked, (spec, trial) = spec, self._updating.look(identity.uid, observed, history)
        if spec is not asked:  # rolled back: its offers may differ
            observed, trouble = self._observe(identity, spec)
        health, judged_at = None, 0
        if observed.machines is not None:
            self._recorder.losses(observed)
            self._ask_about_silent(observed, history)
            health, judged_at = judge(identity.uid, spec, observed, history), history.version
            self._recorder.health(health, history)
        if history.version != judged_at:  # events were added: judge again
            health = None
        begun_at = lifetime.begun_at(intent, identity.created_at, history)
        trouble += lifetime.notes(spec, begun_at, observed.now)
        if abs(observed.doubt_s) >= LEAST_S:
            trouble.append(Reason(Cause.CLOCK_DOUBTED, seconds=observed.doubt_s))
        over = lifetime.is_over(spec, begun_at, observed.now)
        if over:
            intent = replace(intent, stopping=True)
        inputs = Inputs(spec, intent, observed, history)
        decided = plan(identity.uid, inputs, health=health)
        if over:
            reason = Reason(Cause.MAX_HOURS)
            ends = tuple(end._replace(reason=reason) for end in decided.terminations)
            decided = decided._replace(terminations=ends)
        update = None
        if decided.health is not None and not intent.stopping:
            update = self._updating.settle(
                spec, trial, decided.health, wanted=decided.wanted, now=observed.now
            )
        trouble += [update.reason] if update is not None else []
        decided = decided._replace(notes=(*map(self._with_log, decided.notes), *trouble))
        if observed.machines is not None:
            try:
                try:
                    awaited = self._tend_gateway(inputs)
                except (FogftError, OSError):  # machines must end nevertheless
                    self._apply(identity, inputs, decided._replace(launches=()))
                    raise
                if awaited is not None:
                    decided = decided._replace(launches=(), notes=(awaited, *decided.notes))
                self._apply(identity, inputs, decided)
            except (FogftError, OSError) as error:  # disk full, no descriptors, no threads
                log.error("plan_not_applied reason=%r", str(error))
                failed = Reason(Cause.TROUBLE, words=str(error))
                decided = decided._replace(notes=(*decided.notes, failed))
        return Tick(
            identity, spec, intent, observed, decided, self._membership, over, update, trial.file
        )

    def _settle_outcomes(self) -> None:
        for outcome in self.operations.collect():
            id, error = outcome.id, outcome.error
            if error is None:
                continue
            if outcome.subject is None:
                log.warning("terminate_failed replica=%s reason=%r", id.short, str(error))
            else:
                zone = outcome.subject.placement.location
                log.warning(
                    "launch_refused replica=%s zone=%s reason=%r", id.short, zone, str(error)
                )
                cause = _refusal(error)
                if cause:
                    reason = Reason(cause, words=str(error))
                    self._recorder.add(EventKind.REFUSED, id, reason=reason)

    def _observe(self, identity: Identity, spec: PoolSpec) -> tuple[Observed, list[Reason]]:
        trouble: list[Reason] = []
        busy = self.operations.busy()  # before the cloud is asked: see `operations`
        now = self.timekeeping.now
        machines: tuple[Machine, ...] | None = None
        try:
            listed = {m.id: m for m in self.cloud.machines(identity.uid)}
            for id, order in busy.items():
                if order is not None:
                    found = listed.get(id, order)
                    starts = found.phase is MachinePhase.STOPPED
                    listed[id] = replace(order if starts else found, launched_at=now)
            machines = tuple(sorted(listed.values(), key=by_id))
        except CloudError as error:
            log.warning("cloud_unreachable pool=%s reason=%r", identity.name, error.message)
            trouble.append(Reason(Cause.NO_ANSWER, words=told(error)))
        sold = self._current_offers(spec, now, trouble) if machines is not None else ()
        ending = frozenset(id for id, order in busy.items() if order is None)
        links = self.links(identity.uid, now)
        gateway = tuple(m for m in machines or () if m.id.slot == GATEWAY_SLOT)
        stopped = tuple(m for m in machines or () if m.phase is MachinePhase.STOPPED)
        if machines is not None and (gateway or stopped):
            machines = tuple(m for m in machines if m not in (*gateway, *stopped))
        doubt_s = self.timekeeping.watch.doubt_s
        due: frozenset[ReplicaId] = frozenset()
        with contextlib.suppress(FogftError):  # `_publish` reports it; machines must still end
            due = self.ledger.due(min(now, now - doubt_s)) if self.ledger else due
        seen = Observed(now, machines, links, sold, ending, {}, doubt_s, gateway, stopped, due)
        return replace(seen, rtt_s=self.distances(spec, seen)), trouble

    def _ask_about_silent(self, observed: Observed, history: History) -> None:
        """Query the cloud about replicas that fell silent, if it caches its list."""
        cloud = self._refreshing
        if cloud is None:
            return
        for outcome in self._refreshes.collect():
            if outcome.error is not None:
                log.warning("refresh_failed replica=%s reason=%r", outcome.id.short, outcome.error)
        with contextlib.suppress(OSError):  # no thread can be started
            for id in self._silent.due(observed, history):
                if self._refreshes.start(id, None, functools.partial(cloud.refresh, id)):
                    log.info("refresh_ordered replica=%s", id.short)

    def _current_offers(
        self, spec: PoolSpec, now: float, trouble: list[Reason]
    ) -> tuple[Offer, ...]:
        key = spec.derived.get("sales")
        if key is None:
            key = spec.derived["sales"] = json.dumps(sales(spec), sort_keys=True, default=str)
        known = self._offers_for
        if known is None or known[0] != key or not 0 <= now - known[1] < OFFERS_EVERY_S:
            try:
                sold = offers.ask(self.cloud, spec)
                if sold != self._offers:  # else keep the tuple: the planner caches by it
                    self._offers = sold
                self._offers_for = (key, now)
            except FogftError as error:
                trouble.append(Reason(Cause.NO_PRICES, words=told(error)))
                if known is None or known[0] != key:
                    return ()
        return self._offers

    def _tend_gateway(self, inputs: Inputs) -> Reason | None:
        """Manage the gateway that the pool launches; return why replicas must wait, if so."""
        spec, _, observed, history = inputs
        if self.gateway is None or not (spec.gateway.launch or observed.gateway):
            return None
        step = self.gateway.look(inputs)
        cloud = self._refreshing
        is_seen = self.gateway.up_at == observed.now
        is_doubted = cloud is not None and self.gateway.is_doubted(observed.now)
        for machine in observed.gateway:
            record = history.record(machine.id.slot, machine.id.generation)
            was_up = record is not None and record.first_ready_at is not None
            if is_seen and not was_up:
                self._recorder.add(EventKind.READY, machine.id)
            elif is_doubted and was_up and cloud is not None:  # not while it boots
                ask = functools.partial(cloud.refresh, machine.id)
                self._refreshes.start(machine.id, None, ask)
        for id, reason in step.ends:
            if id in step.failed:
                self._recorder.add(EventKind.FAILED, id, reason=reason)
            self._terminate(id, reason, history)
        if step.launch is not None:
            generation = history.generations[GATEWAY_SLOT] + 1
            order = self.gateway.order(spec, step.launch, generation)
            limit = cap_usd(spec, observed)
            self._order(replace(order, limit_usd_per_hour=limit), Reason(Cause.NEW_SLOT))
        there = step.host and spec.dial_in == spec.gateway.endpoints(step.host)[2]
        return None if there or not spec.gateway.launch else step.note

    def _apply(self, identity: Identity, inputs: Inputs, plan: Plan) -> None:
        spec, intent, observed, history = inputs
        self._mark_draining(plan, observed, history)
        slack = _slack(spec, observed, plan)
        starts = standbys.started(inputs, plan.launches, slack)
        stops = standbys.stopped(spec, plan.terminations, observed) if self._stopping else {}
        try:
            self._publish(identity, spec, observed, plan)
        finally:  # before launches, for which a disk may be too full
            for end in plan.terminations:
                stopped = stops.get(end.id)
                kept = None if stopped is None else bare_order(identity, spec, stopped)
                self._terminate(end.id, end.reason, history, stopped=kept)
            for id, reason in standbys.superfluous(
                spec, observed, starts.values(), stopping=intent.stopping
            ):
                self._terminate(id, reason, history)
        for planned in plan.launches:
            started = starts.get(planned.slot)
            order = self.build_order(identity, spec, started or planned)
            order = replace(order, is_there=started is not None)
            if slack is not None:
                order = replace(order, limit_usd_per_hour=order.usd_per_hour + slack)
            self._order(order, (started or planned).reason)

    def _mark_draining(self, plan: Plan, observed: Observed, history: History) -> None:
        ends = {end.id for end in plan.terminations} | observed.ending
        for machine in observed.machines or ():
            record = history.record(machine.id.slot, machine.id.generation)
            if record is None or record.closed is not None:
                continue
            if machine.id in plan.draining:
                if record.draining_since is None:
                    self._recorder.add(EventKind.DRAINING, machine.id)
            elif record.draining_since is not None and machine.id not in ends:
                self._recorder.add(EventKind.UNDRAINED, machine.id)

    def _publish(self, identity: Identity, spec: PoolSpec, observed: Observed, plan: Plan) -> None:
        ledger, are_found = self.ledger, bool(spec.rendezvous or spec.dial_in)
        revoked: frozenset[str] = ledger.revoked() if ledger else frozenset()
        by_hand: frozenset[ReplicaId] = ledger.by_hand() if ledger and are_found else frozenset()
        gateways = ledger.gateways() if ledger and spec.topology else {}
        ending = {end.id for end in plan.terminations} | observed.ending
        machines = observed.machines or ()
        cause = self.epoch, spec, machines, plan.draining, ending, revoked, by_hand, gateways
        if cause == self._published_for:
            return
        members = members_of(
            machines,
            spec,
            pool_uid=identity.uid,
            draining=plan.draining,
            ending=ending,
            revoked=revoked,
            by_hand=by_hand,
        )
        topology = certified(spec.topology, gateways)
        wanted = Membership(
            identity.name, identity.uid, self.epoch, 1, members, revoked, topology=topology
        )
        membership = successor(self._membership, wanted)
        if membership is not None:
            self.store.write_membership(membership)
            self._membership = membership
        self._published_for = cause

    def _order(self, order: Launch, reason: Reason) -> None:
        def record() -> None:
            location = order.placement.location
            self._recorder.add(
                EventKind.LAUNCH,
                order.id,
                location=location,
                reason=reason,
                on_demand=not order.placement.spot,
                version=order.spec_hash,
            )
            why = words(reason)
            log.info("launch_ordered replica=%s zone=%s reason=%r", order.id.short, location, why)

        expected = Machine(
            id=order.id,
            placement=order.placement,
            phase=MachinePhase.PROVISIONING,
            launched_at=self.timekeeping.now,
            usd_per_hour=order.usd_per_hour,
            spec_hash=order.spec_hash,
        )
        self.operations.start(order.id, expected, lambda: self.cloud.launch(order), record)

    def _terminate(
        self, id: ReplicaId, reason: Reason, history: History, *, stopped: Launch | None = None
    ) -> None:
        if id in self.operations.busy():
            return  # its launch is under way: a later tick ends it
        record = history.record(id.slot, id.generation)
        if record is None or not record.ending:
            self._recorder.add(EventKind.ENDING, id, reason=reason)
            log.info("terminate_ordered replica=%s reason=%r", id.short, words(reason))
        never_ready = fault_of(reason) is Cause.NOT_READY
        if stopped is None:
            self.operations.start(id, None, lambda: self._end(id, keep_log=never_ready))
        else:
            self.operations.start(id, None, lambda: self._stop(stopped))

    def _stop(self, order: Launch) -> None:
        """Stop a machine, outside the loop; end it if its cloud cannot stop it."""
        try:
            if self._stopping is not None:
                self._stopping.stop(order)
        except CloudUnreachable:
            raise
        except CloudError as error:
            log.warning("stop_refused replica=%s reason=%r", order.id.short, error.message)
            self.cloud.terminate(order.id)

    def _end(self, id: ReplicaId, *, keep_log: bool) -> None:
        """End a machine, outside the loop; with `keep_log`, keep the tail of its log."""
        if keep_log:
            with contextlib.suppress(CloudError):
                path = self.cloud.log(id)
                self._log_tail = logfile.tail(Path(path), lines=LOG_LINES) if path else ""
        self.cloud.terminate(id)

    def _with_log(self, note: Reason) -> Reason:
        """Return a note; if it is about a replica that was never ready, with its log."""
        hopeless = note.cause is Cause.NEVER_READY and self._log_tail
        if not hopeless or fault_of(note.because[0]) is not Cause.NOT_READY:
            return note
        return replace(note, words=f"\n{self._log_tail}")


def _slack(spec: PoolSpec, observed: Observed, plan: Plan) -> float | None:
    """Return how much more than planned each launch may cost; None without a cap."""
    cap = cap_usd(spec, observed)
    if cap is None or not plan.launches:
        return None
    today = {offer.placement: offer.usd_per_hour for offer in observed.offers}
    spent = sum(today.get(m.placement, m.usd_per_hour) for m in observed.machines or ())
    spent += sum(planned.offer.usd_per_hour for planned in plan.launches)
    return max(0.0, cap - spent) / len(plan.launches)


def _refusal(error: Exception) -> Cause | None:
    """Return the cause of a refused launch; None if the machine may exist nevertheless."""
    if isinstance(error, NoCapacity):
        return Cause.CAPACITY
    if isinstance(error, QuotaExceeded):
        return Cause.QUOTA
    if isinstance(error, CloudError) and type(error) is not CloudError:
        return None  # unreachable: the cloud's list will show it
    return Cause.ERROR
