"""Launch, replace and end the machine of the gateway that a pool runs for itself. Pure.

There is one, on demand. It is replaced when it fails, when its robot no longer reaches it, or when
the file asks for another, but only once it is gone: its successor may use the same ports.

Not here: what is launched on it (`fogft.pool.manager.configuration`).
"""

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from fogft import __version__
from fogft.model.groups import GATEWAY_SLOT, PLACE_KEYS, overridden
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Machine, MachinePhase, Offer, ReplicaId
from fogft.model.spec import PoolSpec
from fogft.planning.observed.history import History
from fogft.planning.observed.launches import given_up
from fogft.planning.sizing import Inputs, cap_usd

LOST_S = 60.0
"""A gateway is replaced when the robot's link to it was down for this many seconds."""
PAUSE_S, LONGEST_PAUSE_S = 10.0, 600.0


class GatewayPlan(NamedTuple):
    """What to do about the gateway's machine."""

    host: str = ""  # its address; empty while unknown
    ends: tuple[tuple[ReplicaId, Reason], ...] = ()  # machines to end, with the reason
    failed: frozenset[ReplicaId] = frozenset()  # those of `ends` whose launch has failed
    launch: Offer | None = None  # what to buy; None for nothing
    note: Reason | None = None  # why no replica is launched before the gateway runs


def version(spec: PoolSpec) -> str:
    """Return 16 hexadecimal digits that change when a running gateway must be replaced."""
    asked = __version__, spec.gateway, resources(spec), sorted(map(str, spec.proxied))
    return hashlib.sha256(repr(asked).encode()).hexdigest()[:16]


def resources(spec: PoolSpec) -> dict[str, Any]:
    """Return the `resources` of the gateway's machine: small, and where the replicas may be."""
    shared = spec.task.get("resources") or {}

    def where(section: Mapping[str, Any]) -> dict[str, Any]:
        return {key: section[key] for key in PLACE_KEYS if key in section}

    out = {**where(shared), "cpus": "2+"}
    for key in ("any_of", "ordered"):
        if shared.get(key):
            out[key] = [where(one) for one in shared[key]]
    return {**overridden(out, spec.gateway.resources), "use_spot": False}


def plan_gateway(inputs: Inputs, offers: Sequence[Offer], *, heard_at: float) -> GatewayPlan:
    """Return the next step; the cloud must have answered.

    Args:
        offers: Suitable on-demand machines, the cheapest first.
        heard_at: When the robot's link to it was last up, or last not observed.
    """
    spec, intent, observed, history = inputs
    here = [m for m in observed.gateway if m.id not in observed.ending]
    newest = max((m.id for m in here), default=None)
    ends, failed, host = [], set(), ""
    for machine in here:
        wanted = spec.gateway.launch and not intent.stopping and machine.id == newest
        fault = _fault(machine, spec, observed.now, history, heard_at) if wanted else None
        if not wanted:
            ends.append((machine.id, Reason(Cause.DOWN if intent.stopping else Cause.NOT_WANTED)))
        elif machine.spec_hash != version(spec):
            ends.append((machine.id, Reason(Cause.OUTDATED)))
        elif machine.id in observed.certificates_due:
            ends.append((machine.id, Reason(Cause.CERTIFICATE_DUE)))
        elif fault is not None:
            failed.add(machine.id)
            ends.append((machine.id, fault))
        elif machine.phase is MachinePhase.RUNNING and machine.endpoint:
            host = machine.endpoint.rpartition(":")[0]
    awaited = Reason(Cause.TROUBLE, words="replicas are launched once the gateway's VM runs")
    step = GatewayPlan(host, tuple(ends), frozenset(failed), note=awaited)
    if observed.gateway or not spec.gateway.launch or intent.stopping:
        return step
    offer, note = _chosen(inputs, offers)
    return step._replace(launch=offer, note=note or awaited)


def _fault(
    machine: Machine, spec: PoolSpec, now: float, history: History, heard_at: float
) -> Reason | None:
    if machine.phase is MachinePhase.FAILED:
        return machine.failure or Reason(Cause.ERROR)
    record = history.record(machine.id.slot, machine.id.generation)
    was_up = record is not None and record.first_ready_at is not None
    runs_since = machine.set_up_at or machine.running_at
    if machine.phase is not MachinePhase.RUNNING or machine.setting_up or not runs_since:
        return None  # the cloud gives up a launch that hangs
    limit_s = LOST_S if was_up else spec.health.start_limit_s
    silent_s = now - max(runs_since, heard_at)
    if silent_s <= limit_s:
        return None
    if was_up:
        return Reason(Cause.SILENT, seconds=silent_s)
    awaited = Reason(Cause.NOT_READY, seconds=limit_s)
    return Reason(Cause.TIMEOUT, because=(awaited,))


def _chosen(inputs: Inputs, offers: Sequence[Offer]) -> tuple[Offer | None, Reason | None]:
    """Return what to buy, or why nothing is bought now."""
    spec, intent, observed, history = inputs
    hopeless = given_up(history, version(spec), history.by_clock(intent.retried_at))
    if hopeless is not None:
        return None, hopeless
    good = [o for o in offers if not intent.is_excluded(o.placement.location)]
    if not good:
        return None, Reason(Cause.NOTHING_OFFERED)
    cap = cap_usd(spec, observed)  # replicas make room: without a gateway they are unreachable
    if cap is not None and good[0].usd_per_hour > cap:
        least = good[0].usd_per_hour
        return None, Reason(Cause.OVER_BUDGET, usd_per_hour=least, limit_usd_per_hour=cap)
    good = [offer for offer in good if cap is None or offer.usd_per_hour <= cap]
    last = history.generations[GATEWAY_SLOT]
    in_vain = 0
    while record := history.record(GATEWAY_SLOT, last - in_vain):
        if record.first_ready_at is not None:
            break
        in_vain += 1
    ended = history.record(GATEWAY_SLOT, last)
    pause_s = min(LONGEST_PAUSE_S, PAUSE_S * 2**in_vain) if in_vain else 0.0
    if ended is not None and 0 <= observed.now - ended.closed_at < pause_s:
        return None, None
    return good[in_vain % len(good)], None
