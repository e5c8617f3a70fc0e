"""How many days of a pool one core simulates in a minute."""

from __future__ import annotations

import random
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from fogft.cloud.local.catalogue import BUILT_IN
from fogft.cloud.local.resources import offers_for
from fogft.model.spec import PoolSpec, ServiceSpec
from fogft.simulation.comparison import Scenario, policies, unlogged
from fogft.simulation.market import remembered
from fogft.simulation.meter import DAY_S
from fogft.simulation.model import MarketModel, Timing
from fogft.simulation.world import World
from tests.estimates import estimate_of_rounds, median

MARKETS = {
    "as the paper's (15 h)": MarketModel(mttf_s=54_000.0, mttr_s=1_200.0),
    "as the V100 traces (3.3 h)": MarketModel(),
}


def simulation(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Time the real manager in markets of ten zones, in processor time, the markets included."""
    rows = []
    for name, model in MARKETS.items():
        for replicas in (2, 4):
            scenario = Scenario(
                PoolSpec(
                    "bench",
                    (ServiceSpec("/plan", "nav_msgs/srv/GetPlan"),),
                    replicas=replicas,
                    task={"run": "plan", "resources": {"use_spot": True}},
                ),
                remembered(lambda resources: offers_for(BUILT_IN, resources)),
                Timing(),
                model,
                days=5.0,
                seeds=tuple(range(5 if quick else 20)),
            )
            make = policies(scenario)["fogft"]
            speeds, asked = [], 0
            for seed in scenario.seeds:
                began = time.process_time()
                world = World(scenario.market(seed), seed=seed, length_s=scenario.length_s)
                with unlogged():
                    world.run(make(world))
                days = scenario.length_s / DAY_S
                speeds.append(days / (time.process_time() - began) * 60)
                asked += world.asked
            rows.append(
                {
                    "market": name,
                    "replicas": replicas,
                    "pool_days": len(scenario.seeds) * scenario.length_s / DAY_S,
                    "planned_per_day": asked / (len(scenario.seeds) * scenario.length_s / DAY_S),
                    "pool_days_per_cpu_minute": asdict(
                        estimate_of_rounds(
                            {"it": speeds}, lambda s: median(s["it"]), random.Random(1)
                        )
                    ),
                    "goal": 1000,
                }
            )
    return rows
