"""A simulation's result as people and programs read it.

Not here: running it (`comparison`) and drawing it (`plot`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from fogft.errors import FogftError
from fogft.pool.manager.offers import ask
from fogft.simulation.comparison import BOUND, Row, Scenario, compare, replicas_of
from fogft.simulation.meter import DAY_S
from fogft.simulation.world import World

MAX_POOL_DAYS = 1_000_000


@dataclass(frozen=True)
class Report:
    """Policies side by side."""

    scenario: Scenario
    rows: tuple[Row, ...]
    replicas: int  # how many the planner wants outside of the schedule's windows
    notes: tuple[str, ...] = ()  # what a reader should know, in sentences

    @property
    def target(self) -> float:
        """The availability that the pool file asks for; else what fogft reached."""
        asked = self.scenario.spec.availability
        return asked.target if asked else self.rows[0].estimate("available").mean

    @property
    def cheapest(self) -> Row | None:
        """The policy that reaches the target for least; None where none does."""
        enough = [
            row
            for row in self.rows
            if row.name != BOUND and row.estimate("available").mean >= self.target
        ]
        return min(enough, key=lambda row: row.estimate("usd_per_hour").mean, default=None)

    def to_json(self) -> dict[str, Any]:
        """Return everything, seed by seed."""
        scenario = self.scenario
        return {
            "pool": scenario.spec.name,
            "replicas": self.replicas,
            "market": "recorded" if scenario.recorded else "modelled",
            "locations": len(scenario.recorded) or None,
            "model": None if scenario.recorded else asdict(scenario.model),
            "zones": {place: list(own) for place, own in scenario.zones.items()},
            "timing": asdict(scenario.timing),
            "days": scenario.days,
            "seeds": list(scenario.seeds),
            "policies": [row.to_json() for row in self.rows],
            "target": self.target,
            "cheapest": self.cheapest.name if self.cheapest else None,
            "notes": list(self.notes),
        }


def simulate(
    scenario: Scenario,
    *,
    notes: Sequence[str] = (),
    told: Callable[[int, int], None] = lambda done, of: None,
) -> Report:
    """Run a scenario. Raises FogftError: it is too long, or longer than what was recorded."""
    scenario, more = _fitting(scenario)
    rows = compare(scenario, told)
    world = World(scenario.market(scenario.seeds[0]), seed=0, length_s=0.0)
    replicas = replicas_of(scenario.spec, ask(world, scenario.spec))
    return Report(scenario, tuple(rows), replicas, (*notes, *more))


def _fitting(scenario: Scenario) -> tuple[Scenario, list[str]]:
    if len(scenario.seeds) * scenario.days > MAX_POOL_DAYS:
        raise FogftError(
            f"{len(scenario.seeds)} seeds of {scenario.days:g} days are more than "
            f"{MAX_POOL_DAYS} pool-days",
            "ask for fewer `--seeds` or `--days`",
        )
    notes = []
    limit_s = scenario.spec.health.start_limit_s
    if 1.25 * scenario.timing.boot_s > limit_s:
        notes.append(
            f"some boots take longer than `health.start_limit_s` ({limit_s:g} s): such launches "
            "count as failed"
        )
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
        notes.append("every seed replays the same days: intervals are of boot times alone")
    return scenario, notes
