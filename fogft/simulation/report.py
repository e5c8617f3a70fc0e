"""Simulate a pool file with prices and traces, and format the result.

Not here: running each policy (`comparison`) and drawing the result (`plot`).
"""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from fogft.errors import FogftError, SpecError
from fogft.model.groups import groups_of, with_spot
from fogft.model.replica import Offer, Placement
from fogft.model.spec import PoolSpec
from fogft.pool.commands.composition import make_cloud
from fogft.poolfile.file import parse, read_text
from fogft.poolfile.named_clouds import cloud_named_by
from fogft.poolfile.named_clouds import located as located_in_file
from fogft.simulation import fitting
from fogft.simulation.comparison import BOUND, Row, Scenario, compare, spot_locations
from fogft.simulation.market import FindOffers, remembered
from fogft.simulation.meter import DAY_S
from fogft.simulation.model import MARKET_KEYS, SLOW, MarketModel, Timing, applied, read_values
from fogft.simulation.timeline import PER_USD
from fogft.simulation.traces import located, read

MAX_POOL_DAYS = 1_000_000


@dataclass(frozen=True)
class Report:
    """A comparison of policies."""

    scenario: Scenario
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()  # what a reader should know, in sentences

    @property
    def one_on_demand(self) -> float | None:
        """US dollars per hour of the cheapest on-demand machine; None if none is sold."""
        _, reserved = self.scenario.sold
        return reserved[0].usd_per_hour if reserved else None

    @property
    def target(self) -> float:
        """The availability that the pool file asks for; else what fogft reached."""
        asked = self.scenario.spec.availability
        return asked.target if asked else self.rows[0].estimate("available").mean

    @property
    def cheapest(self) -> Row | None:
        """The cheapest policy that reaches the target; None if none does."""
        enough = [
            row
            for row in self.rows
            if row.name != BOUND and row.estimate("available").mean >= self.target
        ]
        return min(enough, key=lambda row: row.estimate("usd_per_hour").mean, default=None)

    def in_machines(self, row: Row) -> tuple[float, float] | None:
        """Return a policy's cost in units of one on-demand machine, and of one for each replica."""
        if not self.one_on_demand or not self.scenario.replicas:
            return None
        of_one = row.estimate("usd_per_hour").mean / self.one_on_demand
        return of_one, of_one / self.scenario.replicas

    def to_json(self) -> dict[str, Any]:
        """Return everything as JSON data, including each seed's results."""
        units = [self.in_machines(row) or (None, None) for row in self.rows]
        scenario = self.scenario
        return {
            "pool": scenario.spec.name,
            "replicas": scenario.replicas,
            "market": "recorded" if scenario.recorded else "modelled",
            "locations": len(scenario.recorded) or None,
            "model": None if scenario.recorded else asdict(scenario.model),
            "zones": {place: list(own) for place, own in scenario.zones.items()},
            "timing": asdict(scenario.timing),
            "days": scenario.days,
            "seeds": list(scenario.seeds),
            "one_on_demand_usd_per_hour": self.one_on_demand,
            "policies": [
                {**row.to_json(), "cost_of_one_on_demand": of_one, "cost_of_all_on_demand": of_all}
                for row, (of_one, of_all) in zip(self.rows, units, strict=True)
            ],
            "target": self.target,
            "cheapest": self.cheapest.name if self.cheapest else None,
            "notes": list(self.notes),
        }


def simulate_scenario(
    scenario: Scenario,
    *,
    notes: Sequence[str] = (),
    told: Callable[[int, int], None] = lambda done, of: None,
) -> Report:
    """Run a scenario. Raises FogftError: it is too long, or a trace is too short."""
    scenario, more = _fitting(scenario)
    return Report(scenario, tuple(compare(scenario, told)), (*notes, *more))


def _fitting(scenario: Scenario) -> tuple[Scenario, list[str]]:
    if len(scenario.seeds) * scenario.days > MAX_POOL_DAYS:
        raise FogftError(
            f"{len(scenario.seeds)} seeds of {scenario.days:g} days are more than "
            f"{MAX_POOL_DAYS} pool-days",
            "ask for fewer `--seeds` or `--days`",
        )
    notes = []
    limit_s = scenario.spec.health.start_limit_s
    longest_s = 1.25 * scenario.timing.boot_s * (SLOW if scenario.timing.slow_setup else 1.0)
    if longest_s > limit_s:
        notes.append(
            f"some boots take longer than `health.start_limit_s` ({limit_s:g} s): such launches "
            "count as failed"
        )
    known_s = min((x.length_s for x in scenario.recorded.values()), default=scenario.length_s)
    if any(line.length_s < known_s for line in scenario.prices.values()):
        notes.append("recorded prices end before traces or simulation do: the last one holds on")
    if not scenario.recorded:
        return scenario, notes
    lengths = {place: line.length_s for place, line in scenario.recorded.items()}
    shortest = min(lengths, key=lambda place: lengths[place])
    most = (lengths[shortest] - (scenario.length_s - scenario.days * DAY_S)) / DAY_S
    if most <= 0:
        raise FogftError(
            f"the trace of `{shortest}` is {lengths[shortest]:.0f} s long: too short to simulate",
            "a trace must cover more than an hour",
        )
    if scenario.days >= most:
        scenario = replace(scenario, days=most)
        notes.append(f"the traces cover {most:.1f} days after the first hour: all are used")
        notes.append(
            "every seed replays the same days; intervals are of "
            + ("whole days drawn anew (block bootstrap)" if scenario.replays_all else "boot times")
        )
    return scenario, notes


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
        cloud: The cloud whose prices count; None for the one the pool file names, else `local`.
    """
    source = read_text(file)
    spec = parse(source, file=str(file), folder=file.resolve().parent)
    chosen = cloud or cloud_named_by(spec, source, file)
    find = remembered(_pricing(make_cloud(chosen).offers, source, file))
    values = read_values(model)
    market, timing = MarketModel(), Timing()
    lines: Mapping[str, Any] = {}
    notes: list[str] = []
    zones: Mapping[str, tuple[float, float]] = {}
    if traces is None:
        if fit:
            raise FogftError("`--fit` needs traces to fit to", "give their folder with `--traces`")
        notes.append("the market is simulated; `--traces DIR` replays a recorded one")
    else:
        usable = set(spot_locations(spec, find))
        everywhere = {p.location: p for p in _everything(spec, find)}
        found = located(read(traces), list(everywhere.values()))
        lines = {place: line for place, line in found.items() if place in usable}
        if len(lines) < len(found):
            notes.append(f"{len(found) - len(lines)} traces are for locations outside this pool")
        if len(lines) < len(usable):
            notes.append(
                f"{len(usable) - len(lines)} of the pool's {len(usable)} locations have no trace: "
                "they sell no spot machines here"
            )
        if not lines:
            raise FogftError(
                "no trace covers a location that the pool may use",
                "name the traces' regions under `resources.any_of`",
            )
        told_by_traces = sorted(set(values) & set(MARKET_KEYS))
        if fit:
            seen = fitting.fit(lines)
            market = fitting.feasible(seen)
            if market != seen:
                notes.append(
                    "the generator has no market as correlated as the traces: correlation "
                    f"{market.correlation_region:.2f} within a region in place of "
                    f"{seen.correlation_region:.2f}, {market.correlation_cloud:.2f} between "
                    f"regions in place of {seen.correlation_cloud:.2f}"
                )
            notes.append(
                f"under `availability` write `spot_uptime_s: {market.mttf_s:.0f}` and "
                f"`no_room: {1 - market.availability:.3f}`, as the traces show"
            )
            if not {"mttf_s", "mttr_s"}.intersection(values):
                zones = fitting.of_zones(lines)
                notes += [
                    f"`{place}` never became both full and free: the average of all traces is used"
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
    return simulate_scenario(scenario, notes=notes, told=told)


def _pricing(find: FindOffers, source: str, file: Path) -> FindOffers:
    """Return `find` with errors that name the line of the pool file."""

    def ask(resources: Mapping[str, Any]) -> Sequence[Offer]:
        try:
            return find(resources)
        except SpecError as error:
            raise located_in_file(error, source, file) from None

    return ask


def _everything(spec: PoolSpec, find: FindOffers) -> list[Placement]:
    """Return the placements offered anywhere; at least those that the pool may use."""
    sold = [o for group in groups_of(spec) for o in find(with_spot(group.resources, True))]
    with contextlib.suppress(FogftError):  # not every cloud lists all that it has
        sold += find({"use_spot": True})
    return [offer.placement for offer in sold]
