"""Format a plan: a table of offers, then cost, latency and availability; or JSON."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from fogft.cli import output
from fogft.cli.status_text import age, show_table
from fogft.model.plain import to_plain
from fogft.reason_words import words

if TYPE_CHECKING:
    from rich.text import Text

    from fogft.model.replica import Offer
    from fogft.model.spec import ServiceSpec
    from fogft.planning.cost import Cost
    from fogft.planning.explain import Considered
    from fogft.pool.commands.plan import PlanShown

_MARGIN = 14  # of the summary, for its labels
_HEADER = ("SLOT", "LOCATION", "INSTANCE", "KIND", "$/H", "PRICE", "RTT", "LOST", "WHY NOT")


def show(shown: PlanShown, *, everything: bool = False) -> None:
    """Print the plan: the table of offers and a summary."""
    found = sorted(
        shown.explanation.considered,
        key=lambda x: (not x.slots, x.slots, x.offer.usd_per_hour, x.offer.placement.location),
    )
    listed = found if everything else _best_of_regions(found)
    rows = [_row(shown, one) for one in listed]
    folds = ("LOCATION", "PRICE", "WHY NOT")
    show_table(_HEADER, rows, right=("$/H", "RTT", "LOST"), folds=folds)
    if len(listed) < len(found):
        output.data(f"and {len(found) - len(listed)} more offers in these regions (--all)")
    output.data("")
    if everything and shown.clouds:
        clouds = [(name, "no" if why else "yes", why) for name, why in shown.clouds.items()]
        show_table(("CLOUD", "FITS", "WHY NOT"), clouds, folds=("WHY NOT",))
        output.data("")
    for line in _summary(shown):
        by = 4 if line.startswith(" ") else _MARGIN
        output.data(line[:by] + output.indented(line[by:], by))


def to_json(shown: PlanShown) -> dict[str, Any]:
    """Return the plan as a JSON value. Money in US dollars, times in seconds."""
    plan = shown.explanation
    names = [service.name for service in shown.spec.services]
    return {
        "pool": shown.spec.name,
        "prices_from": shown.cloud,
        "wanted": plan.wanted,
        "max_usd_per_hour": plan.cap,
        "offers": [_offer_json(shown, one) for one in plan.considered],
        "replicas": [
            {
                "slot": replica.slot,
                "group": replica.offer.group,
                **_machine_json(replica.offer),
                "usd_per_hour": replica.offer.usd_per_hour,
                "extras_usd_per_hour": replica.offer.extras_usd_per_hour,
                "rtt_s": plan.rtt_s(replica.offer),
                "services": names,
            }
            for replica in plan.replicas
        ],
        "cost": _cost_json(plan.cost),
        "one_on_demand": plan.single
        and {**_machine_json(plan.single[0]), **_cost_json(plan.single[1])},
        "pool_is_cheapest": plan.is_cheapest,
        "availability": {
            "target": plan.target,
            "expected": plan.expected.correlated,
            "if_independent": plan.expected.independent,
            "services": dict.fromkeys(names or ["*"], vars(plan.expected)),
            "assumed": to_plain(plan.assumed),
        },
        "traffic": {service.name: _traffic_json(shown, service) for service in shown.spec.services},
        "ready_p90_s": shown.ready_p90_s,
        "first_response": {"round_trips_s": plan.round_trips_s},
        "notes": [*shown.notes, *map(words, plan.notes)],
    }


def _traffic_json(shown: PlanShown, service: ServiceSpec) -> dict[str, Any]:
    measured, traffic = shown.traffic.get(service.name), service.traffic
    source = "pool file" if traffic.requests_per_s else None
    return {
        **vars(traffic),
        "source": "measured" if measured else source,
        "measured_over_s": shown.measured_over_s if measured else None,
    }


def _best_of_regions(found: Iterable[Considered]) -> list[Considered]:
    """Return the chosen offers, and the cheapest of each region and kind without a chosen one."""
    out, seen = [], set()
    for one in found:
        place = one.offer.placement
        key = (one.offer.group, place.cloud, place.region, place.spot)
        if one.slots or key not in seen:
            out.append(one)
        seen.add(key)
    return out


def _row(shown: PlanShown, one: Considered) -> list[str | Text]:
    place = one.offer.placement
    return [
        output.cell(",".join(map(str, one.slots)) or "-", "green" if one.slots else "dim"),
        place.location.rstrip("/"),
        place.instance,
        "spot" if place.spot else "on demand",
        f"{one.offer.usd_per_hour:.3f}",
        price_source(one.offer, shown.now) or "simulated",
        "?" if one.rtt_s is None else f"{one.rtt_s * 1000:.0f} ms",
        "-" if one.losses_per_hour is None else f"{one.losses_per_hour:.2f}/h",
        output.cell(words(one.why_not), "dim"),
    ]


def price_source(offer: Offer, now: float) -> str:
    """Return the source and age of an offer's price; empty if the price is simulated."""
    if not offer.source or not offer.as_of:
        return offer.source
    return f"{offer.source}, {age(max(0.0, now - offer.as_of))} old"


def _summary(shown: PlanShown) -> list[str]:
    plan = shown.explanation
    count = len(plan.replicas)
    out = [f"replicas      {count} of {plan.wanted} wanted"]
    out += [f"  slot {one.slot} ({one.offer.group})" for one in plan.replicas if one.offer.group]
    cap = "" if plan.cap is None else f"; the cap is ${plan.cap:.2f}/h"
    out.append(f"cost          {_money(plan.cost)}{cap}")
    extras = sum(replica.offer.extras_usd_per_hour for replica in plan.replicas)
    if extras:
        out.append(f"  ${extras:.3f}/h of it for disks and addresses")
    if shown.ready_p90_s is not None:
        use = "used as the recovery below" if plan.target is None else "set `recovery_s` to it"
        out.append(
            f"ready         within {shown.ready_p90_s:.0f} s of the order "
            f"(p90 of {shown.launches} launches; {use})"
        )
    for name, one in shown.traffic.items():
        out.append(
            f"  {name} measured over {shown.measured_over_s / 3600:.3g} h: "
            f"{one.requests_per_s:.3g} requests/s of {one.request_bytes:.0f} B, "
            f"responses of {one.response_bytes:.0f} B"
        )
    if plan.single is not None:
        offer, alone = plan.single
        compared = ""
        if plan.cost.usd_per_hour:
            ratio = alone.usd_per_hour / plan.cost.usd_per_hour
            compared = f"; {ratio:.2f} times the pool's"
        place = offer.placement
        where = f"{place.instance} at {place.location.rstrip('/')}"
        out.append(f"  one on-demand {where}: {_money(alone)}{compared}")
    out += _availability(shown)
    out += _verdict(shown)
    trips = [f"{rtt_s * 1000:.0f} ms" for rtt_s in plan.round_trips_s]
    if trips:
        best = f"{trips[0]} plus the service's own time"
        second = f"; {trips[1]} while that replica is down" if len(trips) > 1 else ""
        sources = sorted({distance.source for distance in shown.distances.values()})
        out.append(f"response      {best}{second} ({', '.join(sources)})")
    else:
        out.append("response      unknown: no distance is known (`fogft.placement.robot_at`)")
    return out


def _verdict(shown: PlanShown) -> list[str]:
    plan = shown.explanation
    if plan.single is None:
        return []
    target = plan.expected.correlated if plan.target is None else plan.target
    asked = f"for {100 * target:.6g} %"
    reached, usd = plan.with_fallback or (0.0, 0.0)
    single = plan.single[1].usd_per_hour
    if not plan.is_cheapest and reached >= target and usd < single:
        return [f"cheapest      {asked}: with `fogft.on_demand.fallback: true`, about ${usd:.3f}/h"]
    if plan.is_cheapest is None:
        return [f"cheapest      {asked}: neither this pool nor one on-demand machine is enough"]
    if plan.is_cheapest:
        return [f"cheapest      {asked}: this pool"]
    return [f"cheapest      {asked}: one on-demand machine, without fogft"]


def _availability(shown: PlanShown) -> list[str]:
    plan = shown.explanation
    assumed, levels, least = plan.assumed, plan.assumed.correlation, plan.expected
    target = "" if plan.target is None else f", target {plan.target:.6g}"
    return [
        f"availability  {least.correlated:.6f} expected{target} "
        f"({least.independent:.6f} if replicas failed independently)",
        f"  assuming uptime {assumed.spot_uptime_s / 3600:.3g} h spot, "
        f"{assumed.on_demand_uptime_s / 3600:.4g} h on demand; recovery "
        f"{assumed.recovery_s / 60:.3g} min; no capacity "
        f"{100 * assumed.no_room:.3g} % of the time; "
        f"correlation {levels.zone:g} in a zone, {levels.region:g} in a region, "
        f"{levels.cloud:g} in a cloud",
    ]


def _money(cost: Cost) -> str:
    egress = f", ${cost.egress:.3f}/h of it for egress" if cost.egress else ""
    return f"${cost.usd_per_hour:.3f}/h, ${cost.usd_per_month:,.0f} a month{egress}"


def _machine_json(offer: Offer) -> dict[str, Any]:
    place = offer.placement
    return {"location": place.location, "instance": place.instance, "spot": place.spot}


def _cost_json(cost: Cost) -> dict[str, float]:
    return {
        "machines_usd_per_hour": cost.machines,
        "egress_usd_per_hour": cost.egress,
        "usd_per_hour": cost.usd_per_hour,
        "usd_per_month": cost.usd_per_month,
    }


def _offer_json(shown: PlanShown, one: Considered) -> dict[str, Any]:
    place = one.offer.placement
    distance = shown.distances.get(f"{place.cloud}/{place.region}")
    return {
        **to_plain(place),
        "group": one.offer.group,
        "usd_per_hour": one.offer.usd_per_hour,
        "price_source": one.offer.source,
        "price_age_s": shown.now - one.offer.as_of if one.offer.as_of else None,
        "rtt_s": one.rtt_s,
        "rtt_source": None if distance is None else distance.source,
        "recent_losses": one.losses,
        "losses_per_hour": one.losses_per_hour,
        "slots": list(one.slots),
        "why_not": words(one.why_not),
    }
