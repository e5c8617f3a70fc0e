"""Scenarios and pool files for the tests of `fogft.simulation`."""

from __future__ import annotations

from typing import Any

from fogft.cloud.local.catalogue import BUILT_IN
from fogft.cloud.local.resources import offers
from fogft.core.spec import PoolSpec, ServiceSpec
from fogft.simulation.comparison import Scenario
from fogft.simulation.market import remembered
from fogft.simulation.model import MarketModel, Timing

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
    find = remembered(lambda resources: offers(BUILT_IN, resources))
    chosen: dict[str, Any] = {"timing": Timing(), "model": MarketModel(), "days": 1.0}
    return Scenario(pool or spec(), find, **{**chosen, "seeds": (0,), **changes})
