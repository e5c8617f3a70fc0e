"""The pool as fogft runs it: the real reconciler, planner, history and backoff.

Only the cloud, the links and the clock are simulated. This module makes no decisions.

Owns: the link reports, and when the manager may next have something to do.
"""

from collections.abc import Callable
from dataclasses import replace

from fogft.model import schedule
from fogft.model.groups import is_stand_in
from fogft.model.intent import Intent
from fogft.model.replica import LinkReport, LinkState, MachinePhase, Membership, ReplicaId
from fogft.model.spec import PoolSpec
from fogft.planning.endings import DRAIN_LIMIT_S, DRAIN_SETTLE_S
from fogft.planning.fallback import OFTEN_S, SETTLED_S, STAYS_S, losses_of_late
from fogft.planning.migration import STAY_S
from fogft.planning.observed import backoff, launches
from fogft.planning.observed.clock_jumps import Reading
from fogft.planning.observed.hazard import EVERY_S, as_of
from fogft.planning.observed.health import LONE_SILENCE_FACTOR
from fogft.planning.observed.history import Event, History, compacted
from fogft.planning.rollout import Trial
from fogft.pool.folder.store import Identity, PoolStore
from fogft.pool.manager.reconciler import Reconciler, Tick
from fogft.simulation.world import NEVER, TICK_S, UNSEEN, Target, World

UID = "0" * 16
LOOK_EVERY_S = 6 * 3600.0  # a safety net: tests show that the results do not depend on it
_COMPACT_AFTER = 2_000


class _Memory(PoolStore):
    """An in-memory store for the reconciler, with a pool file that never changes."""

    def __init__(self, spec: PoolSpec, now: float) -> None:
        self.the_spec = spec
        self.events: list[Event] = []
        self._appended = 0
        self.published: Membership | None = None
        self._identity = Identity(spec.name, UID, "simulated", "", now)
        self._history = History()

    def identity(self) -> Identity:
        return self._identity

    def spec(self) -> PoolSpec:
        return self.the_spec

    def applied(self) -> str:
        return _TRIAL.file

    def good(self) -> PoolSpec | None:
        return self.the_spec

    def trial(self) -> Trial:
        return _TRIAL

    def intent(self) -> Intent:
        return _NO_WISHES

    def history(self) -> History:
        return self._history

    def append(self, event: Event) -> None:
        self._appended += 1
        self.events.append(event)
        self._history.add(event)

    def membership(self) -> Membership | None:
        return self.published

    def write_membership(self, membership: Membership) -> None:
        self.published = membership

    def compact(self, now: float) -> None:
        if self._appended > _COMPACT_AFTER:
            self._appended = 0
            self.events = compacted(self.events, now, history=self._history)
            self._history = History(self.events)


def _ids(membership: Membership | None) -> set[ReplicaId]:
    return {member.id for member in membership.members} if membership else set()


_NO_WISHES = Intent()
_TRIAL = Trial("simulated")


class Managed:
    """A pool under its manager. Implements `world.Policy`."""

    def __init__(self, world: World, spec: PoolSpec, target: Target) -> None:
        self.world = world
        self.wanted = target
        self.store = _Memory(replace(spec, max_hours=None), world.now)  # `days` limits a run
        health = spec.health
        patience_s = health.replace_after_s
        world.silences = [
            (health.suspect_after_s + TICK_S, self._is_suspicion_felt),
            (patience_s + TICK_S, lambda: True),
            (patience_s * LONE_SILENCE_FACTOR + TICK_S, lambda: True),
        ]
        self._ready = frozenset(service.name for service in spec.services)
        self._reconciler = Reconciler(
            world, self.store, clock=self._clock, links=self._links, prepare=self._prepare
        )

    def _clock(self) -> Reading:
        return Reading(self.world.now, self.world.now, self.world.now)

    def tick(self, now: float) -> float:
        """Run the manager once."""
        self.store.compact(now)
        before = self.store.published
        tick = self._reconciler.tick()
        after = self.store.published
        if after is not before and _ids(after) - _ids(before):  # the next tick sees their links
            return now + TICK_S
        return min(now + LOOK_EVERY_S, self._next_timer(tick))

    def _next_timer(self, tick: Tick) -> float:
        history, now = self.store.history(), tick.observed.now
        health = tick.spec.health
        waits, restless = tick.plan.waits, {(id.slot, id.generation) for id in tick.plan.restless}
        times = [backoff.next_change(history, now, waits=waits, restless=bool(restless))]
        if waits:
            times.append(launches.next_change(history, now))
        if tick.spec.schedule is not None:
            times.append(schedule.next_change(tick.spec.schedule, now))
        if tick.spec.migration:
            times.append(as_of(now) + EVERY_S)
        stands_in = any(is_stand_in(record.slot) for record in history.open())
        for record in history.open():
            if record.draining_since is not None:
                ends = (DRAIN_SETTLE_S, DRAIN_LIMIT_S)
                times += [record.draining_since + limit_s for limit_s in ends]
            if record.first_ready_at is None:
                times.append(record.launched_at + health.start_limit_s + TICK_S)
                continue
            if (record.slot, record.generation) in restless:
                times.append(record.first_ready_at + STAY_S)
            if stands_in:
                times += [at + OFTEN_S for at in losses_of_late(history, now)]
                times += [record.first_ready_at + after_s for after_s in (SETTLED_S, STAYS_S)]
        provisioning = MachinePhase.PROVISIONING
        for machine in tick.observed.machines or ():
            if machine.phase is provisioning:
                times.append(machine.launched_at + health.start_limit_s + TICK_S)
        return min([at for at in times if at > now], default=NEVER)

    def _is_suspicion_felt(self) -> bool:
        """Whether one more suspect link can have any effect.

        A replica that stops serving only holds back endings and moves: that matters only if a
        replica is to end, or if another one is silent, too.
        """
        gone = sum([vm.gone_at < NEVER for vm in self.world.vms.values()])
        return gone > 1 or any(r.draining_since is not None for r in self.store.history().open())

    def _prepare(self, call: Callable[[], None]) -> Callable[[], None]:
        """Return what begins a cloud call: once accepted, the manager sees no effect until boot."""
        vms = self.world.vms

        def answer() -> object:
            before = len(vms)
            call()
            return UNSEEN if len(vms) > before else None

        return lambda: self.world.submit(answer)

    def _links(self, pool_uid: str, now: float) -> tuple[LinkReport, ...]:
        """Report the links to the published members, as the client proxy does."""
        reports = []
        for member in self.store.published.members if self.store.published else ():
            vm = self.world.vms.get(member.id)
            if vm is None:
                continue
            silent_s = max(now - vm.gone_at, 0.0)
            report = vm.report if not silent_s else None
            if report is None:
                silent = silent_s > self.store.the_spec.health.suspect_after_s
                report = vm.report = LinkReport(
                    member.id,
                    LinkState.SUSPECT if silent else LinkState.UP,
                    ready=self._ready,
                    leaving=vm.noticed,
                    silent_for_s=silent_s,
                )
            reports.append(report)
        return tuple(reports)
