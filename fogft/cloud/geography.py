"""Where regions are, and what answers there: for measuring distances, and for guessing them.

A provider's public endpoint of a region ends TCP in that region, so the time to connect is
one round trip. Positions stand in `templates/regions.csv`.

Not here: connecting (`fogft.pool.manager.distances`).
"""

from __future__ import annotations

import csv
import functools
import math

from fogft import template_files

_ENDPOINTS = {
    "aws": "ec2.{region}.amazonaws.com",
    "azure": "{region}.api.cognitive.microsoft.com",
    "gcp": "storage.{region}.rep.googleapis.com",
}
PORT = 443

_EARTH_KM = 6371.0
_FIBRE_KM_PER_S = 200_000.0
_DETOUR = 1.6  # cables do not follow great circles
_ACCESS_S = 0.008  # a robot's own way to the Internet, and a data centre's


def endpoint(region: str) -> tuple[str, int] | None:
    """Return host and port of what answers in a ``cloud/region``; None where none is known."""
    cloud, _, name = region.partition("/")
    pattern = _ENDPOINTS.get(cloud)
    return None if pattern is None or not name else (pattern.format(region=name), PORT)


def position(region: str) -> tuple[float, float] | None:
    """Return latitude and longitude of a ``cloud/region`` in degrees; None where not known."""
    return positions().get(region)


@functools.cache
def positions() -> dict[str, tuple[float, float]]:
    """Return the positions of all regions that are known, by ``cloud/region``."""
    lines = template_files.read_text("regions.csv").splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    return {row["region"]: (float(row["latitude"]), float(row["longitude"])) for row in rows}


def estimated_rtt_s(here: tuple[float, float], there: tuple[float, float]) -> float:
    """Return a guess of the round trip between two positions in seconds, along a great circle."""
    a, b = (math.radians(here[0]), math.radians(there[0]))
    turn = math.radians(there[1] - here[1])
    part = math.sin((b - a) / 2) ** 2 + math.cos(a) * math.cos(b) * math.sin(turn / 2) ** 2
    km = 2 * _EARTH_KM * math.asin(math.sqrt(min(1.0, part)))
    return _ACCESS_S + 2 * km * _DETOUR / _FIBRE_KM_PER_S
