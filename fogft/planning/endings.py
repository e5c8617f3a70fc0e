"""Decide which machines end, and when. Pure.

The law: a replica that serves, or may serve, ends only if enough others serve. Others that are to
end too, have a preemption notice or are silent never count. A replica whose link is up is first
marked as draining, so that it gets no new requests, and ends when it is idle.

Not here: why a replica should end (`classification`, `health`).
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field

from fogft.model.reason import Cause, Reason, because
from fogft.model.replica import ReplicaId
from fogft.planning import fallback
from fogft.planning.observed.health import Assessment, Health, Verdict
from fogft.planning.observed.history import History
from fogft.planning.placement import crowding

# The client proxy needs a moment to read the mark and to report how many requests are in flight.
DRAIN_SETTLE_S = 2.0
DRAIN_LIMIT_S = 10.0


@dataclass
class Endings:
    """The machines to end and to mark now, with notes."""

    now: list[tuple[Assessment, Reason]] = field(default_factory=list)
    draining: list[Assessment] = field(default_factory=list)
    notes: list[Reason] = field(default_factory=list)

    @property
    def ids(self) -> set[ReplicaId]:
        """The machines to end now."""
        return {s.id for s, _ in self.now}


def choose_endings(
    part: fallback.Part,
    health: Health,
    history: History,
    out: Endings,
    *,
    now: float,
    dear_first: bool,
    held: Collection[ReplicaId],
    first: Assessment | None,
) -> None:
    """Add to `out` those of a group's lost, replaced and surplus machines that should end.

    Args:
        held: Outdated replicas that stay until a new one has proved itself.
        first: A replica that ends although it is needed, to make room for its successor.
        dear_first: The pool is over its cap: the most expensive surplus replicas end first.
    """
    wanted, machines, standing_in = part.wanted, part.others, part.standing_in
    extra = fallback.surplus(part, now)
    surplus = len(machines.good) + len(machines.replaced) - wanted
    unwanted = [s for s in standing_in if s.unwanted]
    if surplus <= 0 and not machines.lost and first is None and not unwanted and extra <= 0:
        return
    working = (*machines.good, *machines.replaced, *standing_in)
    chooser = _Chooser(out, wanted, now, {s.id for s in working if s.serving})
    if health.uplink_suspected or not health.links_known:
        if surplus > 0 or machines.lost or unwanted or extra > 0:
            out.notes.append(Reason(Cause.NOBODY_HEARD))
        return
    for replica in machines.lost:
        chooser.end_lost(replica, history)
    if len(machines.good) > wanted:
        expendable = _by_expendability(machines.good, dear_first=dear_first)
        chooser.end_some(expendable, len(machines.good) - wanted, Cause.NOT_WANTED)
    left = surplus - chooser.counted_out
    if first is not None:
        chooser.go(first, Reason(Cause.REPLACED_FIRST, because=because(first.why)))
        left -= 1
    ready_slots = {s.slot for s in machines.good if s.serving}
    replaced = sorted(
        (s for s in machines.replaced if s is not first and s.id not in held),
        key=lambda s: (s.may_serve, s.marked_at, s.slot not in ready_slots, s.id),
    )
    ended = out.ids
    coming = sum(not s.ever_ready for s in machines.good if s.id not in ended)
    chooser.end_some(replaced, left, Cause.REPLACED, coming=coming)
    if unwanted:
        chooser.end_some(unwanted, len(unwanted), Cause.REPLACED)
        extra -= len(unwanted)
    if extra > 0:
        kept = [s for s in standing_in if not s.unwanted]
        kept.sort(key=lambda s: (s.ever_ready, s.marked_at, -s.machine.usd_per_hour, -s.slot))
        chooser.end_some(kept, extra, Cause.ENOUGH_SPOT)


def _by_expendability(replicas: list[Assessment], *, dear_first: bool) -> list[Assessment]:
    """Sort: not serving, then longest draining, then most crowded domain, then highest slot."""
    count = crowding(s.placement for s in replicas)

    def rank(s: Assessment) -> tuple[bool, bool, float, float, int, int, int, int, int]:
        cloud, region, zone = s.placement.domains
        return (
            s.may_serve,
            s.serving,
            s.marked_at,
            -s.machine.usd_per_hour if dear_first else 0.0,
            -count[cloud],
            -count[region],
            -count[zone],
            -s.slot,
            -s.id.generation,
        )

    return sorted(replicas, key=rank)


@dataclass
class _Chooser:
    out: Endings
    wanted: int
    now: float
    pillars: set[ReplicaId]  # those that serve and stay
    counted_out: int = 0

    def end_lost(self, replica: Assessment, history: History) -> None:
        """End a lost replica once it is replaced, or at once if it cannot serve."""
        enough = len(self.pillars) >= self.wanted
        later_served = history.served[replica.slot] > replica.id.generation
        superseded = later_served and replica.verdict is Verdict.UNRESPONSIVE
        if enough or superseded or not replica.ever_ready:
            self.go(replica, replica.why or Reason(Cause.NOT_WANTED))

    def end_some(
        self, replicas: Iterable[Assessment], count: int, cause: Cause, *, coming: int = 0
    ) -> None:
        """End up to `count`, in order, where the law allows it.

        `coming` new replicas have yet to serve: until then, that many old ones stay, even silent.
        """
        for replica in replicas:
            if count <= 0:
                return
            others = len(self.pillars - {replica.id})
            is_missed = replica.may_serve or count <= coming
            if is_missed and others < self.wanted:
                continue
            count -= 1
            self.counted_out += 1
            self.go(replica, Reason(cause, because=because(replica.why)))

    def go(self, replica: Assessment, why: Reason) -> None:
        self.pillars.discard(replica.id)
        if self._must_drain_first(replica):
            self.out.draining.append(replica)
        else:
            self.out.now.append((replica, why))

    def _must_drain_first(self, replica: Assessment) -> bool:
        link = replica.link
        if link is None or not replica.answers or not replica.serving:
            return False
        if replica.draining_since is None:
            return True
        age_s = self.now - replica.draining_since
        if age_s >= DRAIN_LIMIT_S:
            return False
        return age_s < DRAIN_SETTLE_S or link.in_flight > 0
