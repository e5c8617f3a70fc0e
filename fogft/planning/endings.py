"""Decide which machines end, and when. Pure.

The law: a replica that serves, or may serve, ends only if enough others serve. "Others"
never counts one that is itself to go, has a notice, or is silent. One whose link is up is
first marked as draining, so that requests stop going there, and ends when it is idle.

Owns: the order of endings and the two steps of draining.
Not here: why a replica should go (`planner`, `health`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

from fogft.model.reason import Cause, Reason, because
from fogft.model.replica import LinkState, ReplicaId
from fogft.planning.observed.health import Health, Judged, Verdict
from fogft.planning.observed.history import History, Record
from fogft.planning.placement import crowding, domains

# After the mark, the client proxy needs a moment to read it and to report what is in flight.
DRAIN_SETTLE_S = 2.0


@dataclass(eq=False)
class Standing:
    """A judged machine, and why it should be replaced, if it should.

    Attributes:
        id: The replica.
        slot: Its slot.
        record: What is remembered of it; None for nothing.
        verdict: What health says.
    """

    judged: Judged
    reason: Reason | None = None
    id: ReplicaId = field(init=False)
    slot: int = field(init=False)
    record: Record | None = field(init=False)
    verdict: Verdict = field(init=False)

    def __post_init__(self) -> None:
        self.id = self.judged.machine.id
        self.slot = self.id.slot
        self.record, self.verdict = self.judged.record, self.judged.verdict

    @property
    def short(self) -> str:
        """Slot and generation for people."""
        return self.judged.id.short

    @property
    def location(self) -> str:
        """Where it is."""
        return self.judged.machine.placement.location

    @property
    def usd_per_hour(self) -> float:
        """What it costs."""
        return self.judged.machine.usd_per_hour

    @property
    def why(self) -> Reason | None:
        """The reason to replace it, or health's."""
        return self.reason or self.judged.why

    @property
    def ever_ready(self) -> bool:
        """Whether it ever served."""
        if self.judged.serving:
            return True
        return self.record is not None and self.record.first_ready_at is not None

    @property
    def answers(self) -> bool:
        """Whether its server proxy answers."""
        link = self.judged.link
        return link is not None and link.state is LinkState.UP

    @property
    def draining_since(self) -> float | None:
        """When it was marked to go."""
        return self.record.draining_since if self.record is not None else None

    @property
    def marked_at(self) -> float:
        """When it was marked to go; infinity for never: who was marked first goes first."""
        return math.inf if self.draining_since is None else self.draining_since


def is_outdated(standing: Standing) -> bool:
    """Whether it is replaced for its version alone."""
    return standing.reason is not None and standing.reason.cause is Cause.OUTDATED


@dataclass
class Census:
    """Every machine of the pool, by what it is to the pool.

    Attributes:
        good: Serve or will serve.
        replaced: Work, but shall be replaced, new before old.
        lost: Leaving or unresponsive: replaced at once, and not counted as machines.
        failed: Launches that failed: ended at once, not counted.
        aborted: Not wanted as they are, and never served: ended at once.
        ending: Already asked to end.
    """

    good: list[Standing] = field(default_factory=list)
    replaced: list[Standing] = field(default_factory=list)
    lost: list[Standing] = field(default_factory=list)
    failed: list[Standing] = field(default_factory=list)
    aborted: list[Standing] = field(default_factory=list)
    ending: list[Standing] = field(default_factory=list)

    def everyone(self) -> Iterator[Standing]:
        """Yield every machine."""
        yield from self.good
        yield from self.replaced
        yield from self.lost
        yield from self.failed
        yield from self.aborted
        yield from self.ending

    def without(self, others: Collection[Standing]) -> Census:
        """Return the same without some of those that work."""
        good = [s for s in self.good if s not in others]
        replaced = [s for s in self.replaced if s not in others]
        return replace(self, good=good, replaced=replaced)

    def of(self, is_member: Callable[[int], bool]) -> Census:
        """Return the part of it whose slots are members."""
        return Census(
            *(
                [s for s in part if is_member(s.slot)]
                for part in (
                    self.good,
                    self.replaced,
                    self.lost,
                    self.failed,
                    self.aborted,
                    self.ending,
                )
            )
        )

    @property
    def live(self) -> int:
        """Machines that count against `replicas + max_surge`.

        Not those that are lost or have failed, whether or not they were asked to end.
        """
        exempt = (Verdict.FAILED, Verdict.LEAVING, Verdict.UNRESPONSIVE)
        kept = len(self.good) + len(self.replaced) + len(self.aborted)
        return kept + sum(s.verdict not in exempt for s in self.ending)


@dataclass
class Endings:
    """Who ends now, who is marked, and what is worth saying."""

    now: list[tuple[Standing, Reason]] = field(default_factory=list)
    draining: list[Standing] = field(default_factory=list)
    notes: list[Reason] = field(default_factory=list)

    @property
    def ids(self) -> set[ReplicaId]:
        """Those that end now."""
        return {s.id for s, _ in self.now}

    def add(self, other: Endings) -> None:
        """Take in another group's."""
        self.now += other.now
        self.draining += other.draining
        self.notes += other.notes


def choose_endings(
    wanted: int,
    census: Census,
    health: Health,
    history: History,
    *,
    now: float,
    drain_limit_s: float,
    dear_first: bool = False,
    held: Collection[ReplicaId] = (),
    first: Standing | None = None,
    standing_in: Sequence[Standing] = (),
    spare: int = 0,
) -> Endings:
    """Choose who ends of those that are lost, replaced or too many.

    Args:
        standing_in: On-demand machines that serve for others, and are not in the census.
        spare: So many of those that stand in are no longer needed.
        held: Outdated ones that stay until a newcomer has proved itself.
        first: One that makes room for its successor: it ends although it is missed.
        dear_first: The pool is over its cap: of those that are too many the dearest go first.
    """
    surplus = len(census.good) + len(census.replaced) - wanted
    unwanted = [s for s in standing_in if s.reason]
    if surplus <= 0 and not census.lost and first is None and not unwanted and spare <= 0:
        return Endings()
    chooser = _Chooser(wanted, (*census.good, *census.replaced, *standing_in), now, drain_limit_s)
    if health.uplink_suspected or not health.links_known:
        if surplus > 0 or census.lost or unwanted or spare > 0:
            chooser.out.notes.append(Reason(Cause.NOBODY_HEARD))
        return chooser.out
    for standing in census.lost:
        chooser.end_lost(standing, history)
    if len(census.good) > wanted:
        expendable = _by_expendability(census.good, dear_first=dear_first)
        chooser.end_some(expendable, len(census.good) - wanted, Cause.NOT_WANTED)
    if census.replaced:
        _end_replaced(chooser, wanted, census, held, first)
    if unwanted:
        chooser.end_some(unwanted, len(unwanted), Cause.REPLACED)
        spare -= len(unwanted)
    if spare > 0:
        kept = [s for s in standing_in if not s.reason]
        kept.sort(key=lambda s: (s.ever_ready, s.marked_at, -s.usd_per_hour, -s.slot))
        chooser.end_some(kept, spare, Cause.ENOUGH_SPOT)
    return chooser.out


def _end_replaced(
    chooser: _Chooser,
    wanted: int,
    census: Census,
    held: Collection[ReplicaId],
    first: Standing | None,
) -> None:
    left = len(census.good) + len(census.replaced) - chooser.counted_out - wanted
    ready_slots = {s.slot for s in census.good if s.judged.serving}
    if first is not None:
        chooser.make_room(first)
        left -= 1
    replaced = sorted(
        (s for s in census.replaced if s is not first and s.id not in held),
        key=lambda s: (
            s.judged.may_serve,
            s.marked_at,
            s.slot not in ready_slots,
            s.id,
        ),
    )
    ended = chooser.out.ids
    coming = sum(not s.ever_ready for s in census.good if s.id not in ended)
    chooser.end_some(replaced, left, Cause.REPLACED, coming=coming)


def _by_expendability(standings: Iterable[Standing], *, dear_first: bool) -> list[Standing]:
    """Sort: not serving, then longest draining, then most crowded domain, then highest slot."""
    standings = list(standings)
    count = crowding(s.judged.machine.placement for s in standings)

    def rank(s: Standing) -> tuple[bool, bool, float, float, int, int, int, int, int]:
        cloud, region, zone = domains(s.judged.machine.placement)
        return (
            s.judged.may_serve,
            s.judged.serving,
            s.marked_at,
            -s.usd_per_hour if dear_first else 0.0,
            -count[cloud],
            -count[region],
            -count[zone],
            -s.slot,
            -s.id.generation,
        )

    return sorted(standings, key=rank)


class _Chooser:
    def __init__(
        self, wanted: int, working: Iterable[Standing], now: float, drain_limit_s: float
    ) -> None:
        self.out = Endings()
        self.counted_out = 0
        self._wanted = wanted
        self._now = now
        self._drain_limit_s = drain_limit_s
        self._pillars = {s.id for s in working if s.judged.serving}

    def end_lost(self, standing: Standing, history: History) -> None:
        """A lost one ends once it is replaced, or at once when it cannot serve."""
        enough = len(self._pillars) >= self._wanted
        if enough or not standing.ever_ready or self._superseded(standing, history):
            self._go(standing, standing.why or Reason(Cause.NOT_WANTED))

    def _superseded(self, standing: Standing, history: History) -> bool:
        """Whether a later launch of its slot has served: its own turn is over."""
        later = history.served(standing.slot) > standing.id.generation
        return later and standing.verdict is Verdict.UNRESPONSIVE

    def end_some(
        self, standings: Iterable[Standing], count: int, cause: Cause, *, coming: int = 0
    ) -> None:
        """End up to `count`, in order, where the law allows it.

        Args:
            coming: So many of those that are counted have yet to serve. While they are needed,
                one that should come back stays: its successor may never come.
        """
        for standing in standings:
            if count <= 0:
                return
            others = len(self._pillars - {standing.id})
            is_missed = standing.judged.may_serve or count <= coming
            if is_missed and others < self._wanted:
                continue
            count -= 1
            self.counted_out += 1
            self._go(standing, Reason(cause, because=because(standing.why)))

    def make_room(self, standing: Standing) -> None:
        """End one before its successor exists."""
        self._go(standing, Reason(Cause.REPLACED_FIRST, because=because(standing.why)))

    def _go(self, standing: Standing, why: Reason) -> None:
        self._pillars.discard(standing.id)
        if self._must_drain_first(standing):
            self.out.draining.append(standing)
        else:
            self.out.now.append((standing, why))

    def _must_drain_first(self, standing: Standing) -> bool:
        link = standing.judged.link
        if link is None or not standing.answers or not standing.judged.serving:
            return False
        if standing.draining_since is None:
            return True
        age_s = self._now - standing.draining_since
        if age_s >= self._drain_limit_s:
            return False
        return age_s < DRAIN_SETTLE_S or link.in_flight > 0
