"""Track the gateway that a pool launches for itself, and return the next step for it.

Not here: the decision (`planning.gateway`), and carrying it out (`reconciler`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from fogft.cloud.port import Cloud, Launch, Seller
from fogft.errors import FogftError, told
from fogft.model.groups import GATEWAY_SLOT
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Offer
from fogft.model.spec import PoolSpec
from fogft.planning.buying import PlannedLaunch
from fogft.planning.gateway import LOST_S, GatewayPlan, plan_gateway, resources
from fogft.planning.sizing import Inputs

ASK_EVERY_S = 10.0


@dataclass
class LaunchedGateway:
    """The gateway of one pool; `is_up`: whether the robot reaches it; `place` stores its host."""

    cloud: Cloud
    is_up: Callable[[float], bool]
    order: Callable[[PoolSpec, Offer, int], Launch]
    place: Callable[[str], object]
    up_at: float | None = field(default=None, init=False)  # when the robot reached it last
    _asked_at: float = field(default=-math.inf, init=False)
    _looked_at: float = field(default=-math.inf, init=False)
    _watched_since: float = field(default=0.0, init=False)  # not observed before

    def look(self, inputs: Inputs) -> GatewayPlan:
        """Return the next step. The cloud must have answered."""
        spec, intent, observed, _ = inputs
        if observed.links is None or not 0 <= observed.now - self._looked_at < LOST_S / 2:
            self._watched_since = observed.now
        self._looked_at = observed.now
        if self.is_up(observed.now):
            self.up_at = observed.now
        wanted = spec.gateway.launch and not observed.gateway and not intent.stopping
        try:
            sold = offered(self.cloud, spec) if wanted else ()
        except FogftError as error:
            return GatewayPlan(note=Reason(Cause.NO_PRICES, words=told(error)))
        heard_at = max(self.up_at or 0.0, self._watched_since)
        step = plan_gateway(inputs, sold, heard_at=heard_at)
        if step.host and spec.dial_in != spec.gateway.endpoints(step.host)[2]:
            self.place(step.host)
        return step

    def is_doubted(self, now: float) -> bool:
        """Whether to query the cloud now: the gateway was reachable, and is not any more."""
        due = self.up_at not in (None, now) and not 0 <= now - self._asked_at < ASK_EVERY_S
        self._asked_at = now if due else self._asked_at
        return due


def planned(cloud: Seller, spec: PoolSpec) -> tuple[PlannedLaunch, ...]:
    """Return the launch of a pool's first gateway; empty if it launches none."""
    sold = offered(cloud, spec)[:1] if spec.gateway.launch else ()
    return tuple(PlannedLaunch(GATEWAY_SLOT, 1, offer, Reason(Cause.NEW_SLOT)) for offer in sold)


def offered(cloud: Seller, spec: PoolSpec) -> tuple[Offer, ...]:
    """Return the offers for the gateway's machine, the cheapest first."""
    sold = cloud.offers(resources(spec))
    return tuple(sorted(sold, key=lambda o: (o.usd_per_hour, o.placement)))
