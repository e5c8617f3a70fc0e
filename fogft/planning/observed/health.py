"""Judge the health of every replica from its cloud and its links. Pure.

A silent link alone replaces nothing: a silent machine that the cloud lists may be behind a dead
uplink, so silence counts only while another replica answers.
"""

import math
from enum import Enum
from typing import NamedTuple

from fogft.model.groups import is_current
from fogft.model.names import SETUP_LIMIT_S
from fogft.model.reason import Cause, Reason
from fogft.model.replica import (
    LinkReport,
    LinkState,
    Machine,
    MachinePhase,
    Observed,
    Phase,
    Placement,
    ReplicaId,
    by_id,
)
from fogft.model.spec import HealthSpec, PoolSpec
from fogft.planning.observed.history import History, Record

# A single replica's silence looks like a dead uplink. When the cloud still answers after this
# many times `replace_after_s`, the uplink is fine and the replica is not.
LONE_SILENCE_FACTOR = 4.0
# Hints to move a replica count only this long after it was ready: it may just have been moved.
HINT_PAUSE_S = 600.0


class Verdict(str, Enum):
    """The verdict on a replica."""

    GOOD = "good"  # serves, will serve, or has no known fault
    FAILED = "failed"  # its launch has failed, or took longer than `start_limit_s`
    LEAVING = "leaving"  # its cloud or the replica itself reported a preemption notice
    UNRESPONSIVE = "unresponsive"  # silent past `replace_after_s` while another answers
    AT_RISK = "at risk"  # serves, but its cloud recommends moving it
    DISAGREES = "disagrees"  # its answers repeatedly differ from a quorum's, or are missing
    STUCK = "stuck"  # answers probes, but its service has been away past `start_limit_s`


# Cached: looking up an Enum member takes as long as all other checks of a healthy replica.
_UP, _CONNECTING = LinkState.UP, LinkState.CONNECTING
_RUNNING, _READY, _GOOD = MachinePhase.RUNNING, Phase.READY, Verdict.GOOD


class Assessment(NamedTuple):
    """A machine with everything known and decided about it."""

    machine: Machine
    link: LinkReport | None
    record: Record | None  # its history; None without one
    phase: Phase
    verdict: Verdict
    serving: bool  # its link is up and its services are ready: ending it would be felt
    may_serve: bool  # it served once and nothing proves that it does not serve now
    fault: Reason | None = None  # why the verdict is not good; None if it is
    unwanted: Reason | None = None  # why it is to be replaced although it works; None if it is not

    @property
    def id(self) -> ReplicaId:
        """The replica's identity."""
        return self.machine.id

    @property
    def slot(self) -> int:
        """Its slot."""
        return self.machine.id.slot

    @property
    def placement(self) -> Placement:
        """Its location and instance type."""
        return self.machine.placement

    @property
    def why(self) -> Reason | None:
        """Why it is replaced, or its problem."""
        return self.unwanted or self.fault

    @property
    def is_outdated(self) -> bool:
        """Whether it is replaced only because of its version."""
        return self.unwanted is not None and self.unwanted.cause is Cause.OUTDATED

    @property
    def ready_at(self) -> float | None:
        """When it first served; None for never."""
        return self.record.first_ready_at if self.record is not None else None

    def was_ready_for(self, seconds: float, now: float) -> bool:
        """Whether it first served at least this long ago."""
        return self.ready_at is not None and now - self.ready_at >= seconds

    @property
    def ever_ready(self) -> bool:
        """Whether it ever served."""
        return self.serving or self.ready_at is not None

    @property
    def answers(self) -> bool:
        """Whether its server proxy answers."""
        return self.link is not None and self.link.state is _UP

    @property
    def draining_since(self) -> float | None:
        """When it was marked to end."""
        return self.record.draining_since if self.record is not None else None

    @property
    def marked_at(self) -> float:
        """When it was marked to end, for sorting; infinity for never."""
        return math.inf if self.draining_since is None else self.draining_since


class Health(NamedTuple):
    """The health of a pool's replicas, ordered by replica."""

    replicas: tuple[Assessment, ...]
    uplink_suspected: bool  # all links that once answered are silent together
    links_known: bool  # there is a fresh report; without one no replica is doubted


def judge(pool_uid: str, spec: PoolSpec, observed: Observed, history: History) -> Health:
    """Judge the observed replicas. Machines of other pools are left out."""
    links = {report.id: report for report in observed.links or ()}
    ours, heard = [], []
    for machine in sorted(observed.machines or (), key=by_id):
        id = machine.id
        if id.pool_uid != pool_uid:
            continue
        link, record = links.get(id), history.record(id.slot, id.generation)
        serving = link is not None and is_ready(spec, machine, link)
        ours.append((machine, link, record, serving))
        if link is None or machine.phase is not _RUNNING or id in observed.ending:
            continue
        if was_heard(link, record):
            heard.append(link)
    answering = _UP in [link.state for link in heard]
    alone = len(heard) == 1
    patience_s = spec.health.replace_after_s * (LONE_SILENCE_FACTOR if alone else 1.0)
    uplink_suspected = bool(heard) and not answering
    if alone and heard[0].silent_for_s > patience_s:
        uplink_suspected = False
    may_doubt = observed.links is not None and not uplink_suspected
    ready_somewhere = any(serving and not machine.notice for machine, _, _, serving in ours)
    context = _Context(spec.health, observed.now, patience_s, may_doubt, ready_somewhere)
    replicas = tuple([_judge_one(context, *one) for one in ours])
    return Health(replicas, uplink_suspected, links_known=observed.links is not None)


def was_heard(link: LinkReport, record: Record | None) -> bool:
    """Whether this replica ever answered, by its link or an earlier proxy's report."""
    if link.state is not _CONNECTING:
        return True
    ever_ready = record is not None and record.first_ready_at is not None
    return ever_ready and link.silent_for_s > 0


def is_ready(spec: PoolSpec, machine: Machine, link: LinkReport | None) -> bool:
    """Whether a replica answers all its services.

    For an outdated replica, launched for other services, any ready service counts. If a changed
    file lists none, a replica must answer those it offers, until its version's are discovered.
    """
    if link is None or link.state is not _UP or machine.phase is not _RUNNING:
        return False
    if not is_current(spec, machine):
        return bool(link.ready)
    wanted = frozenset(service.name for service in spec.proxied)
    if spec.discovered and not spec.services and spec.discovered_by != machine.spec_hash:
        wanted = frozenset(name for name, _ in link.offered)
    return bool(wanted) and wanted <= link.ready


class _Context(NamedTuple):
    rules: HealthSpec
    now: float
    patience_s: float
    may_doubt: bool
    ready_somewhere: bool


def _judge_one(
    context: _Context,
    machine: Machine,
    link: LinkReport | None,
    record: Record | None,
    serving: bool,
) -> Assessment:
    accused = link is None or link.leaving or link.disagrees or link.at_risk or machine.notice
    if serving and not accused:  # as for nearly all replicas
        return Assessment(machine, link, record, _READY, _GOOD, True, True)
    verdict, why = _verdict(context, machine, link, record, serving)
    may_serve = serving
    if not serving and record is not None and record.first_ready_at is not None:
        answers = link is not None and link.state is _UP
        may_serve = not answers and verdict not in (Verdict.UNRESPONSIVE, Verdict.FAILED)
    phase = _phase(machine, verdict, serving)
    return Assessment(machine, link, record, phase, verdict, serving, may_serve, why)


def _phase(machine: Machine, verdict: Verdict, serving: bool) -> Phase:
    if verdict is Verdict.FAILED:
        return Phase.GONE
    if machine.phase is MachinePhase.PROVISIONING:
        return Phase.PROVISIONING
    if verdict is Verdict.LEAVING:
        return Phase.DRAINING
    return Phase.READY if serving else Phase.STARTING


def _verdict(  # noqa: PLR0911, PLR0912 - one line a verdict reads better than nesting
    context: _Context,
    machine: Machine,
    link: LinkReport | None,
    record: Record | None,
    serving: bool,
) -> tuple[Verdict, Reason | None]:
    health, now = context.rules, context.now
    if machine.phase is MachinePhase.FAILED:
        return Verdict.FAILED, machine.failure or Reason(Cause.ERROR)
    if machine.notice:
        return Verdict.LEAVING, Reason(Cause.NOTICE)
    ready_at = record.first_ready_at if record is not None else None
    if machine.setting_up and not serving and ready_at is None:
        if now - _accepted_at(machine, record, now) > SETUP_LIMIT_S:
            return Verdict.FAILED, _timeout(Cause.NOT_SET_UP, SETUP_LIMIT_S)
        return Verdict.GOOD, None
    if machine.phase is MachinePhase.PROVISIONING:
        if now - _accepted_at(machine, record, now) > health.start_limit_s:
            return Verdict.FAILED, _timeout(Cause.NOT_RUNNING, health.start_limit_s)
        return Verdict.GOOD, None
    if link is not None and link.leaving:
        return Verdict.LEAVING, Reason(Cause.NOTICE_BY_REPLICA)
    silent = link is not None and was_heard(link, record) and link.state is not LinkState.UP
    if link is not None and silent and context.may_doubt and link.silent_for_s > context.patience_s:
        return Verdict.UNRESPONSIVE, Reason(Cause.SILENT, seconds=link.silent_for_s)
    if link is not None and link.disagrees and context.may_doubt:
        ignores = Cause.IGNORES if link.ignores else Cause.DISAGREES
        return Verdict.DISAGREES, Reason(Cause.MISREAD if link.misread else ignores)
    settled = ready_at is not None and now - ready_at >= HINT_PAUSE_S
    if serving and link is not None and link.at_risk and settled:
        return Verdict.AT_RISK, Reason(Cause.AT_RISK)
    if serving or silent or not context.may_doubt:
        return Verdict.GOOD, None
    if record is None or record.first_ready_at is None:
        since = machine.launched_at if record is None else record.launched_at
        since = max(since, machine.set_up_at) if machine.set_up_at <= now else since
        if now - since > health.start_limit_s:
            return Verdict.FAILED, _timeout(Cause.NOT_READY, health.start_limit_s)
        return Verdict.GOOD, None
    away_s = now - record.unready_since if record.unready_since is not None else 0.0
    if away_s > health.start_limit_s and context.ready_somewhere:
        return Verdict.STUCK, Reason(Cause.SERVICE_AWAY, seconds=away_s)
    return Verdict.GOOD, None


def _timeout(awaited: Cause, limit_s: float) -> Reason:
    return Reason(Cause.TIMEOUT, because=(Reason(awaited, seconds=limit_s),))


def _accepted_at(machine: Machine, record: Record | None, now: float) -> float:
    """Return when a launch began.

    The cloud's time is not shifted when our clock is set; the recorded time is.
    """
    if record is None:
        return machine.launched_at
    if machine.launched_at > now:
        return record.launched_at
    return max(machine.launched_at, record.launched_at)
