"""The fraction of time that a replica, or a whole pool, is down. Pure arithmetic.

docs/design/availability.md describes the model, which is exact for any replicas. Ranges are checked
where arguments are read: in the pool file, or the history.

Source: FogROS2-FT, section III.C, which prints the fraction for N upside down.
Not here: how many replicas are launched (`sizing`).
"""

import itertools
import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

from fogft.model.choices import Assumption, Correlation
from fogft.model.replica import Placement

# Decimal fractions are not exact in binary: without this, two replicas of 0.99 miss 0.9999.
_ROUNDING = 1 + 1e-9


def unavailability(uptime_s: float, recovery_s: float) -> float:
    """Return the fraction of time, in [0, 1), that one replica does not answer.

    `uptime_s` is the mean time from ready to gone, `recovery_s` the mean time from gone to ready
    again elsewhere.
    """
    return recovery_s / (uptime_s + recovery_s)


def replicas_needed(availability: float, target: float, *, limit: int = 16) -> int:
    """Return the fewest replicas that together reach a target availability, if independent.

    `availability` is one replica's, in (0, 1]; `target` is in (0, 1). Raises ValueError: `limit`
    is too low.
    """
    allowed = (1 - target) * _ROUNDING
    for count in range(1, limit + 1):
        if (1 - availability) ** count <= allowed:
            return count
    raise ValueError(f"{limit} replicas of {availability:g} do not reach {target:g}")


def unavailability_of(assumed: Assumption, *, spot: bool) -> float:
    """Return the fraction of time that one replica does not answer."""
    uptime_s = assumed.spot_uptime_s if spot else assumed.on_demand_uptime_s
    return unavailability(uptime_s, assumed.recovery_s)


@dataclass(frozen=True)
class Expected:
    """The fraction of time, in [0, 1], that at least one replica answers."""

    correlated: float  # as `Assumption.correlation` says
    independent: float  # if replicas failed independently: the best case, and the paper's


def expected(
    placements: Sequence[Placement], assumed: Assumption, sold: Collection[Placement] = ()
) -> Expected:
    """Return the availability of a pool with replicas in these placements; 0 for none.

    `sold` are the locations that offer spot machines, if nothing else can replace those; empty if
    on-demand machines can.
    """
    down = [unavailability_of(assumed, spot=place.spot) for place in placements]
    each = list(zip(placements, down, strict=True))
    together = joint_unavailability(each, assumed.correlation)
    full = full_together(sold, assumed)
    if full:
        stay = [(place, share) for place, share in each if not place.spot]
        without = joint_unavailability(stay, assumed.correlation)
        together = full * without + (1 - full) * together
    return Expected(1.0 - together, 1.0 - math.prod(down))


def full_together(sold: Collection[Placement], assumed: Assumption) -> float:
    """Return the fraction of time without capacity anywhere, now or one recovery time ago.

    Locations that are full together for a fraction f of the time are modelled as
    log(f) / log(`no_room`) independent ones, and the shortage ends as soon as one of them has room.
    Spot machines are up while their location has room.
    """
    share = assumed.no_room
    full = joint_unavailability([(place, share) for place in sold], assumed.correlation)
    if not sold or not 0 < share < 1 or not 0 < full < 1:
        return full if sold else 0.0
    lasts_s = assumed.spot_uptime_s * share / (1 - share) * math.log(share) / math.log(full)
    return min(1.0, full * (1 + assumed.recovery_s / lasts_s))


def joint_unavailability(
    replicas: Iterable[tuple[Placement, float]], correlation: Correlation
) -> float:
    """Return the fraction of time that all replicas are down together.

    Each replica is given by its placement and the fraction of time that it is down.
    """
    zones: dict[tuple[str, str, str], list[float]] = defaultdict(list)
    steps = {0.0, 1.0}
    for place, down in replicas:
        zones[place.cloud, place.region, place.zone].append(down)
        steps.add(down)
    grid = _Grid(sorted(steps))
    # A replica follows its zone, a zone its region, a region its cloud, with these chances:
    # two replicas share a value when both paths up to it are followed.
    by_replica = math.sqrt(correlation.zone)
    by_zone = math.sqrt(correlation.region / correlation.zone) if correlation.zone else 0.0
    by_region = math.sqrt(correlation.cloud / correlation.region) if correlation.region else 0.0
    regions: dict[tuple[str, str], list[list[float]]] = defaultdict(list)
    for (cloud, region, _), members in zones.items():
        regions[cloud, region].append(grid.followed(grid.down(members, by_replica), by_zone))
    clouds: dict[str, list[list[float]]] = defaultdict(list)
    for (cloud, _), in_region in regions.items():
        clouds[cloud].append(grid.followed(grid.product(in_region), by_region))
    together = (grid.mean(grid.product(in_cloud)) for in_cloud in clouds.values())
    return math.prod(together, start=1.0)


class _Grid:
    """Functions of a domain's value, constant between neighbouring steps."""

    def __init__(self, steps: list[float]) -> None:
        self._widths = [b - a for a, b in itertools.pairwise(steps)]
        self._starts = steps[:-1]

    def down(self, members: Sequence[float], follow: float) -> list[float]:
        """Return the probability that all members are down, given their zone's value."""
        return [
            math.prod(follow * (start < q) + (1 - follow) * q for q in members)
            for start in self._starts
        ]

    def followed(self, inner: list[float], follow: float) -> list[float]:
        """Return a domain's function, given the value of the domain that it lies in."""
        alone = (1 - follow) * self.mean(inner)
        return [follow * value + alone for value in inner]

    def product(self, functions: Sequence[list[float]]) -> list[float]:
        return [math.prod(values) for values in zip(*functions, strict=True)]

    def mean(self, function: Sequence[float]) -> float:
        return math.fsum(w * v for w, v in zip(self._widths, function, strict=True))
