"""One pool of spot replicas in one simulated market: what several experiments look at.

The real manager plans and acts, under simulated time (docs/design/simulation.md). Beside it:
replicas that stay where they are and wait there for room.
"""

from __future__ import annotations

from fogft.cloud.local.catalogue import BUILT_IN
from fogft.cloud.local.resources import offers_for
from fogft.model.spec import HealthSpec, PoolSpec, ServiceSpec
from fogft.simulation.comparison import SETTLE_S, Scenario, policies, unlogged
from fogft.simulation.market import remembered
from fogft.simulation.model import MarketModel, Timing
from fogft.simulation.world import World

_FIND = remembered(lambda resources: offers_for(BUILT_IN, resources))


def unavailable(
    model: MarketModel, timing: Timing, replicas: int, days: float, seed: int
) -> dict[str, float]:
    """Return the fraction of time without an answer, by policy: `fogft` and `static`."""
    spec = PoolSpec(
        "sim",
        (ServiceSpec("/plan", "nav_msgs/srv/GetPlan"),),
        replicas=replicas,
        migration=False,
        health=HealthSpec(start_limit_s=3600.0),  # a boot of 20 min is none that failed
        task={"run": "plan", "resources": {"use_spot": True}},
    )
    scenario = Scenario(spec, _FIND, timing, model, days=days, seeds=(seed,))
    found = {}
    for policy in ("fogft", f"static, any of {replicas}"):
        market = scenario.market(seed)
        world = World(market, seed=seed, length_s=scenario.length_s, settle_s=SETTLE_S)
        with unlogged():
            outcome = world.run(policies(scenario)[policy](world)).outcome()
        found[policy.partition(",")[0]] = 1 - outcome.available
    return found
