"""What a VM costs besides itself: its disk and its public address. Pure.

List prices of 2024-11 in each cloud's cheapest regions, for the disk that SkyPilot orders where no
`disk_tier` is named. Of clouds that are not listed nothing is known; many sell machines with both.
"""

from __future__ import annotations

import re
from typing import Any

from fogft.model.replica import Placement

HOURS_A_MONTH = 730.0
# gp3 on AWS, a balanced disk on GCP; Azure's Premium SSDs have steps, of which this is the usual.
DISK_USD_PER_GB_MONTH = {"aws": 0.08, "azure": 0.15, "gcp": 0.10}
ADDRESS_USD_PER_HOUR = {"aws": 0.005, "azure": 0.005, "gcp": 0.005}
SPOT_ADDRESS_USD_PER_HOUR = {"gcp": 0.0025}
_SIZE = re.compile(r"(\d+(?:\.\d+)?)\s*([kmgtp]?)i?b?\+?", re.IGNORECASE)
_GB = {"k": 1e-6, "m": 1e-3, "": 1.0, "g": 1.0, "t": 1e3, "p": 1e6}


def usd_per_hour(placement: Placement, disk_size: Any) -> float:
    """Return what an address and a disk of a `disk_size` cost."""
    cloud = placement.cloud
    address = ADDRESS_USD_PER_HOUR.get(cloud, 0.0)
    if placement.spot:
        address = SPOT_ADDRESS_USD_PER_HOUR.get(cloud, address)
    disk = disk_gb(disk_size) * DISK_USD_PER_GB_MONTH.get(cloud, 0.0)
    return address + disk / HOURS_A_MONTH


def disk_gb(asked: Any) -> float:
    """Return a `disk_size` as SkyPilot reads it, in GB; 0 for what is none."""
    match = _SIZE.fullmatch(str(asked).strip())
    return float(match[1]) * _GB[match[2].lower()] if match else 0.0
