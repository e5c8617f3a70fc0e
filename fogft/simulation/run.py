"""Simulate a pool file: read it, the prices and the traces, and run every policy on them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fogft.errors import FogftError, SpecError
from fogft.model.groups import groups_of, with_spot
from fogft.model.replica import Offer, Placement
from fogft.model.spec import PoolSpec
from fogft.pool.commands.composition import cloud_named_by, make_cloud
from fogft.poolfile.file import parse, read_text
from fogft.poolfile.named_clouds import located as located_in_file
from fogft.simulation import fitting, report
from fogft.simulation.comparison import Scenario, spot_locations
from fogft.simulation.market import FindOffers, remembered
from fogft.simulation.model import MARKET_KEYS, MarketModel, Timing, applied, read_values
from fogft.simulation.report import Report
from fogft.simulation.timeline import PER_USD
from fogft.simulation.traces import located, read


def simulate(
    file: Path,
    *,
    traces: Path | None = None,
    prices: Path | None = None,
    fit: bool = False,
    model: str = "",
    days: float = 7.0,
    seeds: Sequence[int] = tuple(range(20)),
    cloud: str | None = None,
    told: Callable[[int, int], None] = lambda done, of: None,
) -> Report:
    """Run a pool file and fixed baselines side by side. Launches nothing.

    Args:
        prices: A folder of spot prices, laid out like the traces, in US dollars per hour.
        model: ``KEY=VALUE,...``, see `fogft.simulation.model`.
        cloud: Whose prices; None for the one that the pool file names, else `local`.
        told: Called with how many runs are done, and of how many.
    """
    source = read_text(file)
    spec = parse(source, file=str(file), folder=file.parent)
    chosen = cloud or cloud_named_by(spec, source, file)
    find = remembered(_pricing(make_cloud(chosen, file.resolve().parent).offers, source, file))
    values = read_values(model)
    market, timing = MarketModel(), Timing()
    lines: Mapping[str, Any] = {}
    notes: list[str] = []
    zones: Mapping[str, tuple[float, float]] = {}
    if traces is None:
        if fit:
            raise FogftError("`--fit` needs traces to fit to", "name their folder with `--traces`")
        notes.append("the market is simulated; `--traces DIR` replays a recorded one")
    else:
        usable = set(spot_locations(spec, find))
        everywhere = {p.location: p for p in _everything(spec, find)}
        found = located(read(traces), list(everywhere.values()))
        lines = {place: line for place, line in found.items() if place in usable}
        if len(lines) < len(found):
            notes.append(f"{len(found) - len(lines)} traces are of locations outside this pool")
        if len(lines) < len(usable):
            notes.append(
                f"no trace of {len(usable) - len(lines)} of the pool's {len(usable)} locations: "
                "they sell no spot machines here"
            )
        if not lines:
            raise FogftError(
                "no trace covers a location that the pool may use",
                "name the traces' regions under `resources.any_of`",
            )
        told_by_traces = sorted(set(values) & set(MARKET_KEYS))
        if fit:
            market = fitting.fit(lines)
            notes.append(
                f"under `availability` write `spot_uptime_s: {market.mttf_s:.0f}` and "
                f"`no_room: {1 - market.availability:.3f}`: so the traces say"
            )
            if not {"mttf_s", "mttr_s"}.intersection(values):
                zones = fitting.of_zones(lines)
                notes += [
                    f"`{place}` never became both full and free: it is as all together are"
                    for place in sorted(set(lines) - set(zones))
                ]
            lines = {}
        elif told_by_traces:
            raise FogftError(
                f"--model: `{told_by_traces[0]}` is taken from the traces",
                "add `--fit` to change what was fitted to them",
            )
    market, timing = applied(market, timing, values)
    scenario = Scenario(
        spec,
        find,
        timing,
        market,
        recorded=lines,
        days=days,
        seeds=tuple(seeds),
        zones=zones,
        prices={} if prices is None else located(read(prices, PER_USD), _everything(spec, find)),
    )
    return report.simulate(scenario, notes=notes, told=told)


def _pricing(find: FindOffers, source: str, file: Path) -> FindOffers:
    """Return the same, whose errors name the line of the pool file."""

    def ask(resources: Mapping[str, Any]) -> Sequence[Offer]:
        try:
            return find(resources)
        except SpecError as error:
            raise located_in_file(error, source, file) from None

    return ask


def _everything(spec: PoolSpec, find: FindOffers) -> list[Placement]:
    """Return what can be bought anywhere; at least what the pool may use."""
    sold = [o for group in groups_of(spec) for o in find(with_spot(group.resources, True))]
    with contextlib.suppress(FogftError):  # not every cloud lists all that it has
        sold += find({"use_spot": True})
    return [offer.placement for offer in sold]
