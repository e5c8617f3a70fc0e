"""Classify every machine of a pool: kept, to be replaced, or lost. Pure.

Not here: health (`health`), and moving replicas to better locations (`migration`).
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace

from fogft.model.groups import BLOCK, Group, group_of, is_current
from fogft.model.reason import Cause, Reason
from fogft.model.replica import MachinePhase
from fogft.planning.observed.health import Assessment, Health, Verdict
from fogft.planning.sizing import Inputs, Size

_ORDER = {Cause.DRAINED: 0, Cause.EXCLUDED: 1, Cause.OUTDATED: 3}  # all others between
_OUTDATED = Reason(Cause.OUTDATED)  # shared: many replicas need it at every tick
_LOST = (Verdict.LEAVING, Verdict.UNRESPONSIVE)
_DOUBTED = (Verdict.STUCK, Verdict.AT_RISK, Verdict.DISAGREES)


@dataclass
class Classification:
    """Every machine of the pool, by class."""

    good: list[Assessment] = field(default_factory=list)  # serve or will serve
    # Working, but to be replaced: the successor is launched before the old one ends.
    replaced: list[Assessment] = field(default_factory=list)
    # Leaving or unresponsive: replaced at once, not counted.
    lost: list[Assessment] = field(default_factory=list)
    # Launches that failed: ended at once, not counted.
    failed: list[Assessment] = field(default_factory=list)
    # To be replaced, but never served: ended at once.
    aborted: list[Assessment] = field(default_factory=list)
    ending: list[Assessment] = field(default_factory=list)  # already asked to end

    @property
    def _kinds(self) -> tuple[list[Assessment], ...]:
        kept = self.good, self.replaced, self.lost
        return (*kept, self.failed, self.aborted, self.ending)

    def everyone(self) -> Iterator[Assessment]:
        """Yield every machine."""
        return itertools.chain(*self._kinds)

    def without(self, others: Collection[Assessment]) -> Classification:
        """Return a copy without some of the working machines."""
        good = [s for s in self.good if s not in others]
        replaced = [s for s in self.replaced if s not in others]
        return replace(self, good=good, replaced=replaced)

    def part(self, groups: Sequence[Group], group: Group) -> Classification:
        """Return the machines of one group; the result must not be modified."""
        if len(groups) == 1:
            return self
        kinds = ([s for s in kind if group_of(groups, s.slot) is group] for kind in self._kinds)
        return Classification(*kinds)

    @property
    def live(self) -> int:
        """How many machines count against `replicas + max_surge`: neither lost nor failed ones."""
        exempt = (Verdict.FAILED, Verdict.LEAVING, Verdict.UNRESPONSIVE)
        kept = len(self.good) + len(self.replaced) + len(self.aborted)
        return kept + sum(s.verdict not in exempt for s in self.ending)


def classify(inputs: Inputs, health: Health, size: Size) -> Classification:
    """Classify every machine of the pool."""
    observed = inputs.observed
    machines = Classification()
    blocks = {group.block for group in size.groups}
    for replica in health.replicas:
        if observed.ending and replica.id in observed.ending:
            machines.ending.append(replica)
        elif replica.verdict is Verdict.FAILED:
            machines.failed.append(replica)
        elif replica.verdict in _LOST:
            machines.lost.append(replica)
        elif why := _unwanted(inputs, replica, blocks):
            goes = replica._replace(unwanted=why)
            (machines.aborted if _never_served(goes, health) else machines.replaced).append(goes)
        else:
            machines.good.append(replica)
    _supersede(machines, health, size)
    machines.replaced.sort(key=lambda s: (2 if s.why is None else _ORDER.get(s.why.cause, 2), s.id))
    machines.lost.sort(key=lambda s: (s.verdict is not Verdict.LEAVING, s.id))
    return machines


def _supersede(machines: Classification, health: Health, size: Size) -> None:
    """Replace the older of two good replicas in one slot, if their group has one too many.

    So after a migration the old replica ends, once its successor serves, and not the successor.
    """
    newest = {s.slot: s.id.generation for s in machines.good}  # in the order of generations
    for group, wanted in zip(size.groups, size.counts, strict=True):
        here = machines.part(size.groups, group)
        surplus = len(here.good) + len(here.replaced) - wanted
        old = [s for s in here.good if s.id.generation < newest[s.slot]]
        for replica in old[: max(0, surplus)]:
            machines.good.remove(replica)
            why = Reason(Cause.SUPERSEDED, replica=f"{replica.slot}.{newest[replica.slot]}")
            kind = machines.aborted if _never_served(replica, health) else machines.replaced
            kind.append(replica._replace(unwanted=why))


def _unwanted(inputs: Inputs, replica: Assessment, blocks: Collection[int]) -> Reason | None:
    """Return why a working replica is to be replaced; None if it is not."""
    spec, intent, observed, _ = inputs
    machine, slot = replica.machine, replica.slot
    if replica.id.generation <= intent.drained.get(slot, 0):
        return Reason(Cause.DRAINED)
    if intent.excluded and intent.is_excluded(machine.placement.location):
        return Reason(Cause.EXCLUDED, location=machine.placement.location)
    if replica.id in observed.certificates_due:
        return Reason(Cause.CERTIFICATE_DUE)
    if replica.verdict in _DOUBTED:
        return replica.why
    if slot // BLOCK not in blocks:
        return Reason(Cause.NO_GROUP)
    return None if is_current(spec, machine) else _OUTDATED


def _never_served(replica: Assessment, health: Health) -> bool:
    """Whether a replica certainly never served, so that it can be ended at once."""
    if replica.machine.phase is MachinePhase.PROVISIONING:
        return True
    if health.uplink_suspected or not health.links_known or replica.ever_ready:
        return False
    # Ending an outdated replica that answers probes but has no service ready loses nothing.
    some_ready = replica.link is not None and bool(replica.link.ready)
    return not replica.answers or (replica.is_outdated and not some_ready)
