"""``scripts/simulate``: run the simulations of docs/simulation/ and write the report anew.

The same code gives the same report to the last digit: all chance comes from seeds.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from fogft.cli.simulate import percent
from fogft.cli.status_text import age
from fogft.cloud.local.catalogue import BUILT_IN
from fogft.cloud.local.resources import offers_for
from fogft.model.choices import Assumption, Correlation
from fogft.model.spec import HealthSpec, PoolSpec, ServiceSpec
from fogft.planning.availability import (
    expected,
    joint_unavailability,
    replicas_needed,
)
from fogft.poolfile import file
from fogft.simulation import plot
from fogft.simulation.comparison import (
    SETTLE_S,
    Row,
    Scenario,
    estimate,
    policies,
    static_places,
    unlogged,
)
from fogft.simulation.market import remembered
from fogft.simulation.model import MarketModel, Timing
from fogft.simulation.report import Report, simulate_scenario
from fogft.simulation.world import World
from tests.simulation.arithmetic import moving, staying

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "simulation"
FIND = remembered(lambda resources: offers_for(BUILT_IN, resources))

# Name -> market; the first has the picture.
MARKETS = {
    "scarce, as the public V100 traces": MarketModel(),
    "as the paper takes it: lost every 15 h": MarketModel(mttf_s=54_000.0, mttr_s=3_600.0),
    "independent, lost every 15 h": MarketModel(
        mttf_s=54_000.0, mttr_s=3_600.0, correlation_region=0.0, correlation_cloud=0.0, together=0.0
    ),
    "one fate: correlation 0.6 everywhere, lost every 15 h": MarketModel(
        mttf_s=54_000.0, mttr_s=3_600.0, correlation_region=0.6, correlation_cloud=0.6
    ),
}
WITHOUT_NOTICE = Timing(boot_s=1200.0, notice_s=0.0)  # the paper's recovery of 20 min
PAPER = MarketModel(mttf_s=54_000.0, mttr_s=7_200.0, together=0.0)
# Market -> how many replicas: what `availability` expects is held against what is simulated.
GRID = {
    **{
        replace(PAPER, correlation_region=rho, correlation_cloud=rho): (1, 2, 3)
        for rho in (0.0, 0.22, 0.5)
    },
    MarketModel(): (2, 6),
}


def scenarios(*, quick: bool = False) -> dict[str, Scenario]:
    """Return what is simulated side by side, by name."""
    pool = file.read(FOLDER / "pool.yaml")
    days, seeds = (1.0, range(2)) if quick else (7.0, range(20))
    return {
        name: Scenario(pool, FIND, Timing(), model, days=days, seeds=tuple(seeds))
        for name, model in MARKETS.items()
    }


def main() -> None:
    """Run everything and write ``README.md``, ``figures.json`` and ``planner.png``."""
    parser = argparse.ArgumentParser(prog="scripts/simulate", description=__doc__.splitlines()[0])
    parser.add_argument("--into", type=Path, default=FOLDER, metavar="FOLDER")
    parser.add_argument("--quick", action="store_true", help="little of each: to see that it runs")
    options = parser.parse_args()
    options.into.mkdir(parents=True, exist_ok=True)
    found = {}
    for name, scenario in scenarios(quick=options.quick).items():
        found[name] = simulate_scenario(scenario)
        print(f"simulated: {name}", flush=True)
    first = next(iter(found.values()))
    plot.draw(first, options.into / "planner.png")
    errors = list(arithmetic_errors(quick=options.quick))
    figures = {
        "markets": {name: report.to_json() for name, report in found.items()},
        "arithmetic": errors,
    }
    (options.into / "figures.json").write_text(json.dumps(figures, indent=1) + "\n")
    (options.into / "README.md").write_text("\n".join(page(found, errors)) + "\n")
    print(f"written to {options.into}")


def arithmetic_errors(*, quick: bool = False) -> Iterator[dict[str, Any]]:
    """Yield, for replicas that stay and that move, what arithmetic and what simulation say."""
    days, seeds = (5.0, range(2)) if quick else (20.0, range(8))
    service = ServiceSpec("/plan", "nav_msgs/srv/GetPlan")
    task = {"run": "plan", "resources": {"use_spot": True}}
    for model, counts in GRID.items():
        rho = model.correlation_region
        correlation = Correlation(1.0, rho, model.correlation_cloud)
        for replicas in counts:
            spec = PoolSpec(
                "sim",
                (service,),
                replicas=replicas,
                migration=False,
                health=HealthSpec(start_limit_s=3600.0),  # a boot of 20 min is none that failed
                task=task,
            )
            scenario = Scenario(spec, FIND, WITHOUT_NOTICE, model, days=days, seeds=tuple(seeds))
            offers = FIND({"use_spot": True})
            places = [offer.placement for offer in static_places(offers, replicas)]
            assumed = Assumption(
                spot_uptime_s=model.mttf_s,
                recovery_s=WITHOUT_NOTICE.boot_s + WITHOUT_NOTICE.detect_s,
                no_room=1 - model.availability,
                correlation=correlation,
            )
            one = staying(model, WITHOUT_NOTICE)
            static = joint_unavailability([(place, one) for place in places], correlation)
            elsewhere = expected(places, assumed, [offer.placement for offer in offers])
            for policy, alone, together in (
                (f"static, any of {replicas}", math.prod([one] * replicas), static),
                ("fogft", 1 - elsewhere.independent, 1 - elsewhere.correlated),
            ):
                down = [1 - available(scenario, policy, seed) for seed in scenario.seeds]
                yield {
                    "correlation": rho,
                    "replicas": replicas,
                    "policy": policy.split(",", maxsplit=1)[0],
                    "independent": alone,
                    "expected": together,
                    "simulated": asdict(estimate(down)),
                }
        print(f"arithmetic checked: correlation {rho:g}", flush=True)


def available(scenario: Scenario, policy: str, seed: int) -> float:
    """Return for which fraction of the time a policy's pool answered."""
    world = World(scenario.market(seed), seed=seed, length_s=scenario.length_s, settle_s=SETTLE_S)
    with unlogged():
        return world.run(policies(scenario)[policy](world)).outcome().available


# -- the page ------------------------------------------------------------------------------------


def page(found: dict[str, Report], errors: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of the report."""
    scenario = next(iter(found.values())).scenario
    timing = scenario.timing
    yield from (
        "# A simulation report",
        "",
        "Written by `scripts/simulate`, which anyone can run again; the same code gives the same",
        "figures. Seed by seed they stand in [figures.json](figures.json), how it works in",
        "[the design](../design/simulation.md).",
        "",
        "The pool is [pool.yaml](pool.yaml): two spot replicas of 16 cores, on-demand machines in",
        "their place while no spot can be had. Prices are the local "
        "cloud's ten zones: simulated, in",
        f"the proportions of real ones. Each market has {len(scenario.seeds)} seeds of "
        f"{scenario.days:g} days.",
        f"A boot takes {timing.boot_s:g} s, a notice comes {timing.notice_s:g} s ahead, a loss",
        f"without one is seen after {timing.detect_s:g} s. In brackets: 95 % bootstrap interval.",
        "Costs are in units of one on-demand VM, and of one for each replica.",
    )
    for name, report in found.items():
        yield from ("", f"## A market {name}", "", *table(report))
        if report is next(iter(found.values())):
            yield from ("", "![Costs and curves of the policies](planner.png)")
    yield from ("", "## How far independence can be trusted", "")
    yield from arithmetic_table(errors)


def table(report: Report) -> Iterator[str]:
    """Yield one market's policies, a line each."""
    model = report.scenario.model
    yield (
        f"A zone has room for {model.mttf_s / 3600:.3g} h and none for {model.mttr_s / 3600:.3g} h "
        f"on average; correlation {model.correlation_region:g} within a region, "
        f"{model.correlation_cloud:g} between regions."
    )
    yield ""
    yield (
        "| policy | available | under target | of 1 VM | of "
        f"{report.scenario.replicas} VMs | launches/day | longest outage |"
    )
    yield "|---|---|---|---|---|---|---|"
    yield from (f"| {' | '.join(cells(row, report))} |" for row in report.rows)


def cells(row: Row, report: Report) -> Iterator[str]:
    """Yield what a table says of a policy."""
    up = row.estimate("available")
    yield f"**{row.name}**" if row.name == "fogft" else row.name
    yield f"{percent(up.mean)} [{percent(up.low)}, {percent(up.high)}]"
    yield percent(row.estimate("under_target").mean)
    yield from (f"{unit:.3f}" for unit in report.in_machines(row) or ())
    yield f"{row.estimate('launches_per_day').mean:.1f}"
    yield age(row.longest_outage_s) if row.longest_outage_s else "none"


def arithmetic_table(errors: list[dict[str, Any]]) -> Iterator[str]:
    """Yield what arithmetic and what simulation say, side by side."""
    one = 1 - moving(PAPER, WITHOUT_NOTICE)
    needed = replicas_needed(one, 0.9995)
    yield (
        "Unavailability of spot replicas by `fogft.planning.availability`, which takes them for "
        "independent, and as"
    )
    yield (
        "simulated: lost every 15 h, away for 20 min, the paper's figures, no notice. A zone has "
        "no room for 2 h."
    )
    yield (
        "*Static* replicas wait for it, *fogft* goes elsewhere. By that arithmetic "
        f"{needed} that move suffice for 99.95 %."
    )
    yield ""
    yield (
        "*Expected* is what `availability` reckons with (`fogft.planning.availability`), given "
        "that correlation and how long zones are full. At 0.43: scarce, as the V100 traces."
    )
    yield ""
    yield "| correlation | replicas | policy | independent | expected | simulated | of expected |"
    yield "|---|---|---|---|---|---|---|"
    for row in errors:
        down = row["simulated"]
        yield (
            f"| {row['correlation']:g} | {row['replicas']} | {row['policy']} | "
            f"{100 * row['independent']:.3g} % | {100 * row['expected']:.3g} % | "
            f"{100 * down['mean']:.3g} % "
            f"[{100 * down['low']:.3g}, {100 * down['high']:.3g}] | "
            f"{down['mean'] / row['expected']:.2g} |"
        )


if __name__ == "__main__":
    main()
