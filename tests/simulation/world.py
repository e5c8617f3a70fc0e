"""A pool's whole world under simulated time: cloud, replicas, robot's links, manager.

The laws are checked where they could be broken: at every launch, every termination and
every write. Nothing here knows how the planner decides.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from fogft.cloud.port import Launch
from fogft.model.reason import Cause
from fogft.model.replica import LinkReport, LinkState, Machine, MachinePhase, ReplicaId
from fogft.model.spec import PoolSpec, ServiceSpec
from fogft.planning.observed.clock_jumps import Reading
from fogft.pool.folder.store import Identity
from fogft.pool.manager.reconciler import Reconciler, Tick
from tests.fakes.cloud import MockCloud, zones
from tests.simulation.memory_store import MemoryStore

UID = "0123456789abcdef"
STRANGER = "fedcba9876543210"
SERVICE = ServiceSpec("/plan", "nav_msgs/srv/GetPlan")
START = 1_700_000_000.0


class Killed(BaseException):
    """The manager was killed here."""


class CheckedCloud(MockCloud):
    """A mock cloud that checks the laws of launching and ending, and crashes its caller."""

    world: World

    def launch(self, order: Launch) -> None:
        self.world.crash_point()
        self.world.check_launch(order)
        super().launch(order)
        self.world.crash_point()

    def terminate(self, id: ReplicaId) -> None:
        self.world.crash_point()
        self.world.check_terminate(id)
        super().terminate(id)
        self.world.crash_point()


class RememberingCloud(CheckedCloud):
    """Lists from memory: what ran once is listed until somebody asks about it, or ends it."""

    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **others)
        self.remembered: dict[ReplicaId, Machine] = {}
        self.refreshed: list[ReplicaId] = []

    def machines(self, pool_uid: str) -> Sequence[Machine]:
        found = {m.id: m for m in super().machines(pool_uid)}
        running = {id: m for id, m in found.items() if m.phase is MachinePhase.RUNNING}
        self.remembered |= running
        of_pool = {id: m for id, m in self.remembered.items() if id.pool_uid == pool_uid}
        listed = {**of_pool, **found}
        return [listed[id] for id in sorted(listed)]

    def terminate(self, id: ReplicaId) -> None:
        super().terminate(id)
        self.remembered.pop(id, None)

    def refresh(self, id: ReplicaId) -> None:
        self._meet("refresh")
        self.refreshed.append(id)
        self.remembered.pop(id, None)  # the next list has it again if it is there


class World:
    """One pool by seed. `step` lets time pass; `tick` lets the manager work."""

    def __init__(
        self,
        seed: int,
        spec: PoolSpec,
        places: tuple[str, ...],
        cloud: type[CheckedCloud] = CheckedCloud,
    ) -> None:
        self.random = random.Random(seed)
        self.now = START
        self.spec = spec
        self.store = MemoryStore(Identity(spec.name, UID, "mock", "/pool.yaml", START), spec)
        self.store.crash_point = self.crash_point
        self.cloud = cloud(lambda: self.now, zones(*places), seed=seed)
        self.cloud.world = self
        self.frozen: set[ReplicaId] = set()
        self.crashing: set[ReplicaId] = set()  # their service is away
        self.told: set[ReplicaId] = set()  # of their end, by a notice that only they hear
        self.at_risk: set[ReplicaId] = set()  # their cloud recommends to move them
        self.broken: dict[str, str] = {}  # version -> what is wrong with it, see `wrong`
        self.clock_ahead_s = 0.0  # of the robot: the cloud's is right
        self.uplink_down = False
        self.proxy_down = False
        self.echo_draining = self.random.random() < 0.5
        self.deferred = self.random.random() < 0.5
        self.start_s = self.random.choice([0.5, 4.0])
        self.kill_in: int | None = None
        self.kills = 0
        self.whole_ticks = 0
        self._heard_at: dict[ReplicaId, float] = {}
        self._dialled_at: dict[ReplicaId, float] = {}
        self._ran_at: dict[ReplicaId, float] = {}
        self._reported: dict[ReplicaId, LinkReport] = {}
        self._ordered: set[ReplicaId] = set()
        self._queue: list[Callable[[], None]] = []
        self._stranger = self._admit_stranger()
        self.manager = self.new_manager(epoch=1)

    # -- the manager ------------------------------------------------------------------------

    def new_manager(self, epoch: int) -> Reconciler:
        return Reconciler(
            self.cloud,
            self.store,
            clock=lambda: Reading(self.now + self.clock_ahead_s, self.now, self.now),
            links=self.links,
            prepare=lambda run: partial(self._queue.append, run) if self.deferred else run,
            epoch=epoch,
        )

    def tick(self) -> Tick | None:
        """Let the manager work once; None when it was killed. Its successor comes next tick."""
        try:
            queue, self._queue[:] = list(self._queue), []
            self.random.shuffle(queue)
            for index, run in enumerate(queue):
                if self.random.random() < 0.3:
                    self._queue.append(run)
                else:
                    try:
                        run()
                    except Killed:
                        self._queue += queue[index + 1 :]
                        raise
            tick = self.manager.tick()
            self._check_plan(tick)
        except Killed:
            self.kills += 1
            self.kill_in = None
            self._queue.clear()
            self.store.reopen()
            epoch = self.store.published.epoch if self.store.published else 0
            self.manager = self.new_manager(epoch + 1)
            return None
        return tick

    def crash_point(self) -> None:
        if self.kill_in is not None:
            self.kill_in -= 1
            if self.kill_in <= 0:
                raise Killed

    # -- time and links -----------------------------------------------------------------------

    def step(self, seconds: float) -> None:
        """Let time pass."""
        self.now += seconds
        for machine in self.truth():
            if machine.phase is MachinePhase.RUNNING:
                self._ran_at.setdefault(machine.id, self.now)
                alive = machine.id not in self.frozen and not self.uplink_down
                if alive and machine.id in self.member_ids():
                    self._heard_at[machine.id] = self.now

    def member_ids(self) -> set[ReplicaId]:
        return {m.id for m in self.store.published.members} if self.store.published else set()

    def truth(self) -> list[Machine]:
        """Return the machines that exist, whatever the cloud says to the manager."""
        return self.cloud.present()

    def serves(self, id: ReplicaId) -> bool:
        """Whether a replica's service would answer if asked on its own machine."""
        ran_at = self._ran_at.get(id)
        started = ran_at is not None and self.now - ran_at >= self.start_s
        if self.wrong(id) in ("crashes", "hangs"):
            return False
        return started and id not in self.frozen and id not in self.crashing

    def wrong(self, id: ReplicaId) -> str:
        """Return what is wrong with a replica's version: ``crashes``, ``hangs``, ``errs`` or ''."""
        machine = self.cloud.machine(id) if self.broken else None
        return self.broken.get(machine.spec_hash, "") if machine else ""

    def versions(self) -> dict[ReplicaId, str]:
        """Return which version each machine runs."""
        return {m.id: m.spec_hash for m in self.truth() if m.id.pool_uid == UID}

    def _asked(self, id: ReplicaId, *, serving: bool) -> dict[str, int]:
        """Count restarts and requests: three a second, of which an erring version fails half."""
        ran_s = max(0.0, self.now - self._ran_at.get(id, self.now))
        asked = int(3 * ran_s) if serving else 0
        failed = asked // 2 if self.wrong(id) == "errs" else asked // 200
        restarts = int(ran_s / 2) if self.wrong(id) == "crashes" else 0
        return {"restarts": restarts, "answered": asked - failed, "failed": failed}

    def links(self, pool_uid: str, now: float) -> tuple[LinkReport, ...] | None:
        """Report as the client proxy does: of the published members, by what was heard."""
        now = self.now  # its own clock is steady
        self._reported = {}
        if self.proxy_down:
            return None
        alive = {m.id for m in self.truth() if m.phase is MachinePhase.RUNNING} - self.frozen
        for member in self.store.published.members if self.store.published else ():
            dialled_at = self._dialled_at.setdefault(member.id, now)
            heard_at = self._heard_at.get(member.id)
            silent = now - (heard_at if heard_at is not None else dialled_at)
            up = member.id in alive and not self.uplink_down
            if up:
                self._heard_at[member.id], silent, state = now, 0.0, LinkState.UP
            elif heard_at is None:
                state = LinkState.CONNECTING
            elif silent > self.spec.health.suspect_after_s:
                state = LinkState.SUSPECT
            else:
                state = LinkState.UP
            serving = state is LinkState.UP and (not up or self.serves(member.id))
            leaving = up and member.id in self.told
            draining = leaving or (member.draining and self.echo_draining)
            self._reported[member.id] = LinkReport(
                member.id,
                state,
                ready=frozenset({SERVICE.name}) if serving else frozenset(),
                leaving=leaving,
                draining=draining,
                at_risk=up and member.id in self.at_risk,
                silent_for_s=silent,
                in_flight=self.random.randrange(2) if serving else 0,
                **self._asked(member.id, serving=serving),
            )
        return tuple(self._reported.values())

    # -- laws ---------------------------------------------------------------------------------

    def wanted(self) -> int:
        return self.store.the_intent.wanted(self.store.the_spec, self.now)

    def check_launch(self, order: Launch) -> None:
        assert order.id not in self._ordered, f"generation {order.id.short} is used twice"
        higher = [i for i in self._ordered if i.slot == order.id.slot and i > order.id]
        assert not higher, f"{order.id.short} after {higher}"
        self._ordered.add(order.id)
        if self.deferred:
            return  # the wish may have changed since it was planned: see `_check_plan`
        live = [m for m in self.truth() if m.id.pool_uid == UID and not self._exempt(m)]
        assert len(live) + 1 <= self.wanted() + self.spec.max_surge, [m.id.short for m in live]
        assert not self.store.the_intent.is_excluded(order.placement.location)
        cap = self.spec.max_usd_per_hour
        spent = sum(m.usd_per_hour for m in self.truth() if m.id.pool_uid == UID)
        assert cap is None or spent + order.usd_per_hour <= cap + 1e-9

    def _exempt(self, machine: Machine) -> bool:
        health = self.spec.health
        heard_at = self._heard_at.get(machine.id, self._dialled_at.get(machine.id, self.now))
        silent = self.now - heard_at > health.replace_after_s
        late = self.now - machine.launched_at > health.start_limit_s
        record = self.store.history().record(machine.id.slot, machine.id.generation)
        late = late and (record is None or record.first_ready_at is None)
        report = self._reported.get(machine.id)
        leaving = machine.notice or (report is not None and report.leaving)
        return leaving or machine.phase is MachinePhase.FAILED or silent or late

    def check_terminate(self, id: ReplicaId) -> None:
        assert id.pool_uid == UID, "a stranger's machine is ended"

    def _check_plan(self, tick: Tick) -> None:
        """Check the laws against what the manager was told when it decided."""
        listed = {m.id for m in self.truth()}
        busy = self.manager.operations.busy()
        queued = [id for id, order in busy.items() if order is not None and id not in listed]
        live = [m for m in self.truth() if m.id.pool_uid == UID and not self._exempt(m)]
        if tick.plan.launches:
            assert len(live) + len(queued) <= self.wanted() + self.spec.max_surge
        if self.store.the_intent.stopping:
            return
        gone = {end.id for end in tick.plan.terminations} | tick.observed.ending
        noticed = {m.id for m in tick.observed.machines or () if m.notice}
        serving = {r.id for r in self._reported.values() if r.ready}
        known = {m.id for m in tick.observed.machines or ()}
        left = (serving & known) - gone - noticed
        for end in tick.plan.terminations:
            if end.id in serving:
                makes_room = end.reason.cause is Cause.REPLACED_FIRST
                needed = max(1, self.wanted() - 1) if makes_room else self.wanted()
                assert len(left) >= needed, f"{end.id.short} served; left: {left}"
        if known and len(serving & known) >= self.wanted():
            self.whole_ticks += 1

    def check_now(self) -> None:
        """Check what must hold after every step."""
        assert any(m.id == self._stranger for m in self.truth()), "the stranger was touched"

    def whole(self) -> bool:
        """Whether exactly the wanted replicas exist and all of them serve the robot."""
        ours = [m for m in self.truth() if m.id.pool_uid == UID]
        members = self.member_ids()
        return len(ours) == self.wanted() and all(
            self.serves(m.id) and m.id in members and not m.notice for m in ours
        )

    def _admit_stranger(self) -> ReplicaId:
        id = ReplicaId(STRANGER, 0, 1)
        placement = next(iter(self.cloud.zones.values())).placement
        order = Launch(id, "other", placement, 0.1, "")
        MockCloud.launch(self.cloud, order)
        return id
