"""What the local cloud pretends to sell: regions, zones, instances and their prices.

Prices are made up, in the proportions of real ones. ``regions.yaml`` in the cloud's folder
replaces any of it (`regions_file`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from fogft.model.replica import Placement

CLOUD = "local"


@dataclass(frozen=True)
class Zone:
    """One zone.

    Attributes:
        boot_s: From the order until the machine runs.
        notice_s: Between a preemption notice and the end.
        capacity: How many machines fit.
        price_factor: Of all prices here.
        relay: Whether a relay stands before the machines, so that links can be slowed and cut.
    """

    region: str
    name: str
    boot_s: float = 0.5
    notice_s: float = 5.0
    capacity: int = 8
    price_factor: float = 1.0
    relay: bool = True

    @property
    def location(self) -> str:
        """``local/region/zone``."""
        return f"{CLOUD}/{self.region}/{self.name}"


@dataclass(frozen=True)
class Instance:
    """A kind of machine. Prices in US dollars per hour, before a zone's factor."""

    name: str
    cpus: int
    memory_gb: int
    usd_per_hour: float
    spot_usd_per_hour: float
    accelerators: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Catalogue:
    """Everything on sale."""

    zones: tuple[Zone, ...]
    instances: tuple[Instance, ...]

    @property
    def regions(self) -> list[str]:
        """Names of the regions, sorted."""
        return sorted({zone.region for zone in self.zones})

    def zone_of(self, placement: Placement) -> Zone | None:
        """Return the zone of a placement, if it is one of ours."""
        return next((zone for zone in self.zones if zone.location == placement.location), None)


INSTANCES = (
    Instance("cpu4", 4, 16, 0.192, 0.066),
    Instance("cpu8", 8, 32, 0.384, 0.131),
    Instance("cpu16", 16, 64, 0.768, 0.259),
    Instance("cpu32", 32, 128, 1.536, 0.515),
)

# Region: what its prices are multiplied by, and its boot time.
REGIONS = {
    "us-west-2": (1.00, 0.4),
    "us-east-1": (1.03, 0.5),
    "us-west-1": (1.17, 0.5),
    "eu-central-1": (1.20, 0.6),
    "ap-northeast-1": (1.29, 0.8),
}

BUILT_IN = Catalogue(
    zones=tuple(
        Zone(region, zone, boot_s=boot_s, price_factor=round(factor * more, 3))
        for region, (factor, boot_s) in REGIONS.items()
        for zone, more in (("a", 1.0), ("b", 1.04))
    ),
    instances=INSTANCES,
)
