"""Plan a pool file and explain its cost and availability. Nothing is launched."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from fogft.cloud.port import RealCloud, Seller
from fogft.cloud.table import PriceTable
from fogft.errors import CloudError, PoolNotFound, SpecError
from fogft.model.choices import TrafficSpec
from fogft.model.groups import groups_of, with_spot
from fogft.model.intent import Intent
from fogft.model.plain import from_plain
from fogft.model.replica import Observed, Offer
from fogft.model.spec import PoolSpec
from fogft.planning.explain import Explanation, explain
from fogft.planning.observed.history import Event, EventKind, History
from fogft.planning.sizing import Inputs
from fogft.pool.commands.composition import LOCAL, make_cloud, make_store
from fogft.pool.folder.paths import latency_file
from fogft.pool.manager import launched_gateway, offers, proxy_report
from fogft.pool.manager.distances import Distance, Latencies, regions_of
from fogft.pool.manager.proxy_report import ProxyReport
from fogft.poolfile import named_clouds
from fogft.poolfile.file import parse, read_text

LEAST_LAUNCHES = 5  # fewer are not representative


@dataclass(frozen=True)
class PlanShown:
    """A plan with the data that it is based on.

    Attributes:
        cloud: The cloud adapter or the table that the prices come from.
        clouds: What each cloud lacks for this pool; empty on the local cloud.
        distances: ``cloud/region`` -> how far it is, and how that is known.
        traffic: Service name -> what its client proxy counted in the last `measured_over_s`, if the
            file gives no traffic.
        ready_p90_s: How long nine in ten of this pool's launches took at most; None for too few.
    """

    spec: PoolSpec
    now: float
    cloud: str
    explanation: Explanation
    distances: Mapping[str, Distance]
    notes: tuple[str, ...]
    traffic: Mapping[str, TrafficSpec] = field(default_factory=dict)
    measured_over_s: float = 0.0
    ready_p90_s: float | None = None
    launches: int = 0
    clouds: Mapping[str, str] = field(default_factory=dict)


def plan_file(
    file: Path,
    cloud: str | None = None,
    *,
    prices: Path | None = None,
    offline: bool = False,
    told: Callable[[str], None] = lambda _: None,
) -> PlanShown:
    """Plan a pool file from scratch. Queries clouds for prices and distances only.

    Prices come from `cloud`, by default the one that the resources name, else `local`; or from the
    table `prices`. If `offline`, no distance is measured. `told` is called before slow steps.
    """
    source = read_text(file)
    spec = parse(source, file=str(file), folder=file.resolve().parent)
    seller: Seller
    if prices is not None:
        name, seller = str(prices), PriceTable(prices)
    else:
        name = cloud or named_clouds.cloud_named_by(spec, source, file)
        seller = make_cloud(name)
        if name != LOCAL:
            told("fetching prices")
    try:
        sold = offers.ask(seller, spec)
        on_demand = _on_demand(seller, spec)
        beside = launched_gateway.planned(seller, spec)
    except SpecError as error:
        raise named_clouds.located(error, source, file) from None
    if not sold:
        raise CloudError(
            "no cloud offers these resources at the moment",
            "relax the resources, or name other places",
        )
    distances, notes = far(spec, sold, offline=offline, told=told)
    notes += seller.left_out() if isinstance(seller, RealCloud) else ()
    notes += [
        f"the gateway's VM costs ${one.offer.usd_per_hour:.3f}/h more: "
        f"`{one.offer.placement.instance}` on demand in `{one.offer.placement.location}`"
        for one in beside
    ]
    try:
        store = make_store(spec.name)
        events = store.recent(1 << 30)
        intent, history, took_s = store.intent(), History(events), ready_after(events)
        report = proxy_report.read(store.paths.proxy_status, store.identity().uid)
    except PoolNotFound:
        intent, history, took_s, report = Intent(), History(), [], None
    silent = {service.name for service in spec.services if service.traffic == TrafficSpec()}
    counted = {name: one for name, one in measured(report).items() if name in silent}
    services = (replace(one, traffic=counted.get(one.name, one.traffic)) for one in spec.services)
    spec = replace(spec, services=tuple(services))
    now = time.time()
    observed = Observed(now, (), None, sold, rtt_s={r: d.rtt_s for r, d in distances.items()})
    ready_p90_s = took_s[int(0.9 * len(took_s))] if len(took_s) >= LEAST_LAUNCHES else None
    inputs = Inputs(spec, intent, observed, history)
    explained = explain(inputs, on_demand, recovery_s=ready_p90_s)
    clouds = (
        seller.lacking(spec.task.get("resources") or {}) if isinstance(seller, RealCloud) else {}
    )
    return PlanShown(
        *(spec, now, name, explained, distances, tuple(notes), counted),
        measured_over_s=0.0 if report is None else report.uptime_s,
        ready_p90_s=ready_p90_s,
        launches=len(took_s),
        clouds=clouds,
    )


def ready_after(events: Sequence[Event]) -> list[float]:
    """Return how long launches took from order to readiness, in seconds, the shortest first."""
    ordered: dict[tuple[int, int], float] = {}
    took_s: list[float] = []
    for event in events:
        key = event.slot, event.generation
        if event.kind is EventKind.LAUNCH:
            ordered[key] = event.at
        elif event.kind is EventKind.READY and key in ordered:
            took_s.append(max(0.0, event.at - ordered.pop(key)))
    return sorted(took_s)


def far(
    spec: PoolSpec,
    sold: Sequence[Offer],
    *,
    offline: bool = False,
    told: Callable[[str], None] = lambda _: None,
) -> tuple[Mapping[str, Distance], list[str]]:
    """Return the distances to the regions of offers, where the pool file's take precedence, and
    notes on those that could not be measured; if `offline`, none is measured.
    """
    regions, latencies, notes = regions_of(sold), Latencies(latency_file()), []
    if not offline and (stale := latencies.stale(regions)):
        told(f"measuring round trips to {len(stale)} regions")
        failed = latencies.measure(stale)
        if failed:
            region, why = next(iter(failed.items()))
            notes.append(f"{len(failed)} regions cannot be measured, such as `{region}`: {why}")
    return latencies.known(regions, spec.placement, {}), notes


def _on_demand(seller: Seller, spec: PoolSpec) -> Sequence[Offer]:
    """Return the offers of one on-demand machine of the pool's last group; none if not sold."""
    try:
        return seller.offers(with_spot(groups_of(spec)[-1].resources, False))
    except (SpecError, CloudError):
        return ()


# Over a shorter time, one burst would be taken for a month's traffic.
LEAST_S = 60.0


def measured(report: ProxyReport | None) -> dict[str, TrafficSpec]:
    """Return the measured traffic of each service that has any."""
    if report is None or not report.uptime_s >= LEAST_S:
        return {}
    found = {}
    for name, raw in report.services.items():
        count = from_plain(proxy_report.Counted, raw)
        if count.received:
            found[name] = TrafficSpec(
                count.received / report.uptime_s,
                count.request_bytes / count.received,
                count.response_bytes / max(1, count.answered),
            )
    return found
