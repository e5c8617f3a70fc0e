"""Run policies side by side in the same markets, one market per seed.

Not here: showing the results (`fogft.cli`, `plot`).
"""

import logging
import math
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cache, cached_property, partial
from statistics import fmean
from typing import Any

from fogft.model.groups import groups_of, with_spot
from fogft.model.intent import Intent
from fogft.model.replica import Observed, Offer
from fogft.model.spec import PoolSpec
from fogft.planning.listing import Scale, catalogue
from fogft.planning.observed.history import History
from fogft.planning.placement import Market as Offered
from fogft.planning.sizing import Inputs, size
from fogft.pool.manager.offers import ask
from fogft.simulation.baselines import ActiveZones, InTurn, Naive, Search, Static
from fogft.simulation.bound import least_usd_per_hour
from fogft.simulation.managed import Managed
from fogft.simulation.market import FindOffers, Market
from fogft.simulation.meter import DAY_S, HOURS_A_MONTH, Outcome
from fogft.simulation.model import MarketModel, Timing, generate
from fogft.simulation.timeline import Timeline
from fogft.simulation.world import EPOCH, Policy, Target, World

SETTLE_S = 3600.0
BOUND = "omniscient"
FIGURES = (
    "available",
    "under_target",
    "mean_ready",
    "usd_per_hour",
    "launches_per_day",
    "preemptions_per_day",
    "outages_per_day",
)
# Figure -> the two sums over days whose ratio it is, and its unit.
_OF_DAYS = {
    "available": ("up_s", "wanted_s", 1.0),
    "under_target": ("under_s", "wanted_s", 1.0),
    "mean_ready": ("ready_s", "seconds", 1.0),
    "usd_per_hour": ("usd", "seconds", 3600.0),
}
_RESAMPLES = 1000


@dataclass(frozen=True)
class Scenario:
    """The scenario of a simulation."""

    spec: PoolSpec
    find: FindOffers  # what a cloud offers for a task's `resources`
    timing: Timing
    model: MarketModel  # from which markets are generated
    # Location -> its recorded capacity; empty to generate markets.
    recorded: Mapping[str, Timeline] = field(default_factory=dict)
    days: float = 7.0  # how long each run is measured, after the first hour
    seeds: Sequence[int] = tuple(range(20))  # one run each
    # Location -> its own MTTF and MTTR, if they differ from the model's.
    zones: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    # Location -> price of a spot machine over time, if it is not that of `find`.
    prices: Mapping[str, Timeline] = field(default_factory=dict)

    @property
    def length_s(self) -> float:
        """How long each run takes, in simulated seconds."""
        return SETTLE_S + self.days * DAY_S

    @property
    def replays_all(self) -> bool:
        """Whether every seed replays the whole recording, two days or more."""
        known_s = min((line.length_s for line in self.recorded.values()), default=math.inf)
        return known_s - 1.0 < self.length_s and self.days >= 2.0

    @cached_property
    def replicas(self) -> int:
        """How many replicas the planner wants outside the schedule's windows."""
        return self._wanted(replace(self.spec, schedule=None), EPOCH)

    @cached_property
    def _offers(self) -> tuple[Offer, ...]:
        return ask(self.market(self.seeds[0]), self.spec)

    def _wanted(self, spec: PoolSpec, now: float) -> int:
        seen = Observed(now, (), None, self._offers)
        return size(Inputs(spec, Intent(), seen, History())).total

    @cached_property
    def sold(self) -> tuple[list[Offer], list[Offer]]:
        """The spot and the on-demand offers for the pool's largest group; the latter by price."""
        kind = max(groups_of(self.spec), key=lambda group: group.replicas).resources
        market = self.market(self.seeds[0])
        spots = [o for o in market.offers(with_spot(kind, True)) if o.placement.spot]
        reserved = [o for o in market.offers(with_spot(kind, False)) if not o.placement.spot]
        return spots, sorted(reserved, key=lambda o: (o.usd_per_hour, o.placement))

    def target(self) -> Target:
        """Return a function from time to the wanted number of replicas, without prelaunches."""
        schedule = self.spec.schedule
        if schedule is None:
            return lambda now: self.replicas
        punctual = replace(self.spec, schedule=replace(schedule, prelaunch_s=0.0))

        @cache
        def wanted(minute: int) -> int:
            return self._wanted(punctual, 60.0 * minute)

        return lambda now: wanted(int(now // 60))

    def market(self, seed: int) -> Market:
        """Return the market of a seed: a section of the recordings, or a generated one."""
        chance = random.Random(f"market {seed}")
        if not self.recorded:
            lines = generate(
                self.model,
                spot_locations(self.spec, self.find),
                self.length_s,
                chance,
                self.zones,
            )
            return Market(self.find, lines, self.timing, self.prices)
        known_s = min(line.length_s for line in self.recorded.values())
        begin_s = chance.uniform(0, known_s - self.length_s) if known_s > self.length_s else 0.0
        lines, prices = (
            {place: line.window(begin_s, self.length_s) for place, line in known.items()}
            for known in (self.recorded, self.prices)
        )
        return Market(self.find, lines, self.timing, prices)


def spot_locations(spec: PoolSpec, find: FindOffers) -> list[str]:
    """Return the locations with spot machines for a pool, sorted."""
    sold = (o for group in groups_of(spec) for o in find(with_spot(group.resources, True)))
    return sorted({o.placement.location for o in sold if o.placement.spot})


@dataclass(frozen=True)
class Estimate:
    """A mean over seeds with its 95 % bootstrap interval."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class Row:
    """One policy over all seeds."""

    name: str
    outcomes: tuple[Outcome, ...]
    # Of the first seed: times in seconds from the beginning, with the number serving from then on.
    curve: tuple[tuple[float, int], ...] = ()
    same_days: bool = False  # all seeds replay the same days

    def estimate(self, figure: str) -> Estimate:
        """Return a figure's mean and interval; ``..._per_day`` is per day."""
        if self.same_days and figure in _OF_DAYS:
            return self._over_days(*_OF_DAYS[figure])
        if figure.endswith("_per_day"):
            counted = figure.removesuffix("_per_day")
            values = [getattr(o, counted) / (o.seconds / DAY_S) for o in self.outcomes]
        else:
            values = [getattr(o, figure) for o in self.outcomes]
        return estimate(values)

    def _over_days(self, above: str, below: str, unit: float) -> Estimate:
        """Return a ratio with its interval by block bootstrap: whole days are resampled."""
        days = [
            [
                sum(getattr(outcome.days[index], sums) for outcome in self.outcomes)
                for sums in (above, below)
            ]
            for index in range(min(len(outcome.days) for outcome in self.outcomes))
        ]

        def ratio(drawn: Sequence[Sequence[float]]) -> float:
            return sum(day[0] for day in drawn) / max(sum(day[1] for day in drawn), 1e-9) * unit

        return estimate(days, ratio)

    @property
    def longest_outage_s(self) -> float:
        """The longest of all outages."""
        return max(o.longest_outage_s for o in self.outcomes)

    def to_json(self) -> dict[str, Any]:
        """Return all figures."""
        figures = {figure: asdict(self.estimate(figure)) for figure in FIGURES}
        out: dict[str, Any] = {"policy": self.name, **figures}
        out["usd_per_month"] = out["usd_per_hour"]["mean"] * HOURS_A_MONTH
        out["longest_outage_s"] = self.longest_outage_s
        out["by_seed"] = [asdict(replace(o, days=())) for o in self.outcomes]
        return out


def estimate(values: Sequence[Any], of: Callable[[Sequence[Any]], float] = fmean) -> Estimate:
    """Return a statistic of some values with its interval, deterministically."""
    chance = random.Random(len(values))
    found = sorted(of(chance.choices(values, k=len(values))) for _ in range(_RESAMPLES))
    return Estimate(of(values), found[int(0.025 * _RESAMPLES)], found[int(0.975 * _RESAMPLES)])


Factory = Callable[[World], Policy]


def policies(scenario: Scenario) -> dict[str, Factory]:
    """Return a factory of each policy, by name; fogft first.

    The fixed policies use machines of the pool's largest group, as many as the pool has replicas.
    """
    spec, target, replicas = scenario.spec, scenario.target(), scenario.replicas
    spots, reserved = scenario.sold
    found: dict[str, Factory] = {"fogft": lambda world: Managed(world, spec, target)}
    if reserved:
        found["one on-demand"] = lambda world: Static(world, reserved[:1], target)
    if spots:
        places = static_places(spots, replicas)
        found[f"static, any of {len(places)}"] = lambda world: Static(world, places, target)
        search = partial(Search, spot=spots, replicas=replicas, wanted=target)
        found["SkyServe, spot only"] = partial(search, on_demand=None, rule=ActiveZones)
        if reserved:
            search = partial(search, on_demand=reserved[0])
            found["SkyServe, fallback"] = partial(search, rule=ActiveZones)
            found["SpotHedge"] = partial(search, rule=ActiveZones, extra=1)
            found["naive"] = partial(search, rule=Naive)
            found["round robin"] = partial(search, rule=InTurn)
    return found


def static_places(offers: Sequence[Offer], count: int) -> list[Offer]:
    """Return a well-spread fixed placement of this many replicas."""
    chosen: list[Offer] = []
    market = Offered(catalogue(offers).listing(None, None, (), Scale()))
    for _ in range(count):
        offer = market.choose([one.placement for one in chosen]).offer
        if offer is not None:
            chosen.append(offer)
    return chosen


def compare(
    scenario: Scenario, told: Callable[[int, int], None] = lambda done, of: None
) -> list[Row]:
    """Run every policy in every market; `told` is called with the runs done and in total."""
    made = policies(scenario)
    outcomes: dict[str, list[Outcome]] = {name: [] for name in made}
    curves: dict[str, tuple[tuple[float, int], ...]] = {}
    for index, seed in enumerate(scenario.seeds):
        market = scenario.market(seed)
        for number, (name, make) in enumerate(made.items()):
            told(index * len(made) + number, len(made) * len(scenario.seeds))
            world = World(market, seed=seed, length_s=scenario.length_s, settle_s=SETTLE_S)
            with unlogged():
                meter = world.run(make(world))
            outcomes[name].append(meter.outcome())
            curve = tuple((at - meter.begin_s, ready) for at, ready in meter.curve)
            curves.setdefault(name, curve)
    same = scenario.replays_all
    rows = [Row(name, tuple(outcomes[name]), curves[name], same) for name in made]
    known = [bound(scenario, scenario.market(seed)) for seed in scenario.seeds]
    reached = tuple(outcome for outcome in known if outcome is not None)
    # The bound assumes one kind of machine, list prices, and a constant number of replicas.
    varies = scenario.prices or scenario.spec.schedule or scenario.spec.groups
    if len(reached) == len(known) and not varies:
        rows.append(Row(BOUND, reached))
    return rows


def bound(scenario: Scenario, market: Market) -> Outcome | None:
    """Return the cost of all replicas always ready, with perfect foresight; None if impossible."""
    spots, reserved = scenario.sold
    cheapest = {
        o.placement.location: o.usd_per_hour for o in sorted(spots, key=lambda o: -o.usd_per_hour)
    }
    seconds = scenario.length_s - SETTLE_S
    usd_per_hour = least_usd_per_hour(
        {place: line.window(SETTLE_S, seconds) for place, line in market.timelines.items()},
        cheapest,
        reserved[0].usd_per_hour if reserved else None,
        scenario.replicas,
        boot_s=scenario.timing.boot_s,
        length_s=seconds,
    )
    if usd_per_hour is None:
        return None
    return Outcome(seconds, 1.0, 0.0, float(scenario.replicas), usd_per_hour, 0, 0, 0, 0, 0.0)


@contextmanager
def unlogged() -> Iterator[None]:
    """Silence the manager's log, because its events are simulated."""
    log = logging.getLogger("fogft.pool")
    before = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        log.setLevel(before)
