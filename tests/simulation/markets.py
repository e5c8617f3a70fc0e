"""Scenarios and pool files for the tests of `fogft.simulation`."""

from __future__ import annotations

import random
from typing import Any

from fogft.cloud.local.catalogue import BUILT_IN
from fogft.cloud.local.resources import offers_for
from fogft.model.choices import OnDemandSpec, ScheduleSpec, WindowSpec
from fogft.model.spec import HealthSpec, PoolSpec, ServiceSpec
from fogft.simulation.comparison import Scenario
from fogft.simulation.market import remembered
from fogft.simulation.model import MarketModel, Timing
from fogft.simulation.world import Policy

EVERY_DAY = frozenset(range(7))
# Nothing between two zones, changes often: much happens in a short time.
INDEPENDENT = MarketModel(
    mttf_s=14_400.0, mttr_s=3_600.0, correlation_region=0.0, correlation_cloud=0.0, together=0.0
)


def spec(replicas: int = 2, **changes: Any) -> PoolSpec:
    """A pool on the local cloud's ten zones."""
    task = {"run": "plan", "resources": {"use_spot": True}}
    service = ServiceSpec("/plan", "nav_msgs/srv/GetPlan")
    return PoolSpec("sim", (service,), replicas=replicas, task=task, **changes)


def scenario(pool: PoolSpec | None = None, **changes: Any) -> Scenario:
    """A short simulation, at the local cloud's prices."""
    find = remembered(lambda resources: offers_for(BUILT_IN, resources))
    chosen: dict[str, Any] = {"timing": Timing(), "model": MarketModel(), "days": 1.0}
    return Scenario(pool or spec(), find, **{**chosen, "seeds": (0,), **changes})


class EveryTick:
    """A policy that is asked as often as the manager's loop, not only when something can change."""

    def __init__(self, policy: Policy) -> None:
        self.wanted = policy.wanted
        self._policy = policy

    def tick(self, now: float) -> float:
        """Act, and ask to be called again at once."""
        self._policy.tick(now)
        return now


def any_scenario(seed: int, days: float = 0.02) -> Scenario:
    """Any pool in any market, by seed: scarce and rich, with every rule that looks at the clock."""
    chance = random.Random(f"scenario {seed}")
    among = chance.choice
    window = WindowSpec(
        EVERY_DAY,
        among([0, 1200, 3600]),
        among([2400, 4800, 9000]),
        replicas=chance.randrange(6),
        max_usd_per_hour=among([None, None, 0.3]),
    )
    pool = spec(
        chance.randrange(1, 6),
        on_demand=among(
            [OnDemandSpec(), OnDemandSpec(1), OnDemandSpec(0, True), OnDemandSpec(1, True)]
        ),
        schedule=among([None, ScheduleSpec("UTC", (window,), prelaunch_s=among([0.0, 600.0]))]),
        max_usd_per_hour=among([None, None, 0.25, 0.5]),
        max_surge=among([0, 1, 2]),
        migration=among([False, True]),
        health=HealthSpec(start_limit_s=among([900.0, 200.0])),
    )
    timing = Timing(
        boot_s=among([30.0, 240.0, 400.0]),
        notice_s=among([0.0, 30.0, 120.0]),
        detect_s=among([1.0, 5.0, 30.0, 100.0]),
        answer_s=among([1.0, 5.0, 20.0]),
        on_demand_mttf_s=among([0.0, 7200.0]),
    )
    scarce = MarketModel(mttf_s=2_000.0, mttr_s=4_000.0)
    model = among([MarketModel(), scarce, INDEPENDENT])
    return scenario(pool, timing=timing, model=model, days=days, seeds=(seed,))
