"""How long the planner thinks."""

from __future__ import annotations

import itertools
import random
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from fogft.model.choices import AvailabilitySpec, OnDemandSpec
from fogft.model.intent import Intent
from fogft.model.replica import Observed, Offer, Placement
from fogft.model.spec import PoolSpec, ServiceSpec
from fogft.planning.observed.history import History
from fogft.planning.planner import plan
from fogft.planning.sizing import Inputs
from tests.bench.caller import milliseconds
from tests.estimates import median

UID = "0" * 16
CLOUDS, REGIONS, ZONES, INSTANCES = 5, 50, 4, 5
REPLICAS = 16


def planning(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Plan pools of 16 replicas from nothing over 5 000 offers, with distances to all regions.

    In processor time. *New* offers are seen for the first time, as after each change of prices;
    *known* ones were planned with before, as at every other tick of a manager.
    """
    service = (ServiceSpec("/plan", "nav_msgs/srv/GetPlan"),)
    target = AvailabilitySpec(target=0.99999)
    pools = {
        "16 replicas": PoolSpec("bench", service, replicas=REPLICAS),
        "16 replicas under a cap": PoolSpec(
            "bench", service, replicas=REPLICAS, max_usd_per_hour=4.0
        ),
        "8 spot, 8 on demand": PoolSpec(
            "bench", service, replicas=REPLICAS, on_demand=OnDemandSpec(8, True)
        ),
        "16 at least, with a target": PoolSpec(
            "bench", service, replicas=REPLICAS, availability=target
        ),
    }
    observed = _observed()
    took: dict[tuple[str, str], list[float]] = {
        (name, offers): [] for name in pools for offers in ("new", "known")
    }
    for number in range(1 + (5 if quick else 30)):
        for name, spec in pools.items():
            observed = replace(observed, offers=observed.offers[:-1] + observed.offers[-1:])
            for offers in ("new", "known"):
                began = time.process_time()
                planned = plan(UID, Inputs(spec, Intent(), observed, History()))
                if number:
                    took[name, offers].append(time.process_time() - began)
                assert len(planned.launches) == REPLICAS
    return [
        {
            "pool": name,
            "offers": f"{len(observed.offers)} {offers}",
            "runs": len(sample),
            "median_ms": median(milliseconds(sample)),
            "longest_ms": max(milliseconds(sample)),
            "goal": 50,
        }
        for (name, offers), sample in took.items()
    ]


def _observed() -> Observed:
    """Return a made-up market, always the same."""
    made = random.Random(1)
    places = itertools.product(range(CLOUDS), range(REGIONS), range(ZONES), range(INSTANCES))
    offers = tuple(
        Offer(
            Placement(f"c{c}", f"r{r}", f"z{z}", f"m{m}", spot=m % 2 == 0),
            made.uniform(0.05, 2.0),
        )
        for c, r, z, m in places
    )
    rtt_s = {
        f"c{c}/r{r}": made.uniform(0.01, 0.2)
        for c, r in itertools.product(range(CLOUDS), range(REGIONS))
    }
    return Observed(1.7e9, (), None, offers, rtt_s=rtt_s)
