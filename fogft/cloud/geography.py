"""Where regions are, and what answers there: for measuring distances, and for guessing them.

A provider's public endpoint of a region ends TCP in that region, so the time to connect is
one round trip. Positions are those of the cities or states that providers name, to a degree.

Not here: connecting (`fogft.pool.manager.distances`).
"""

from __future__ import annotations

import math

_ENDPOINTS = {
    "aws": "ec2.{region}.amazonaws.com",
    "azure": "{region}.api.cognitive.microsoft.com",
    "gcp": "storage.{region}.rep.googleapis.com",
}
PORT = 443

_PLACES = {
    "virginia": (39, -78), "ohio": (40, -83), "california": (37, -122), "oregon": (46, -121),
    "montreal": (45, -73), "calgary": (51, -114), "sao-paulo": (-23, -47), "dublin": (53, -6),
    "london": (51, 0), "paris": (49, 2), "frankfurt": (50, 9), "zurich": (47, 9),
    "stockholm": (59, 18), "milan": (45, 9), "spain": (41, -1), "tokyo": (36, 140),
    "osaka": (35, 136), "seoul": (37, 127), "singapore": (1, 104), "sydney": (-34, 151),
    "melbourne": (-38, 145), "mumbai": (19, 73), "hyderabad": (17, 78), "hong-kong": (22, 114),
    "jakarta": (-6, 107), "bahrain": (26, 51), "cape-town": (-34, 18), "iowa": (41, -96),
    "south-carolina": (33, -80), "las-vegas": (36, -115), "los-angeles": (34, -118),
    "salt-lake-city": (41, -112), "dallas": (33, -97), "belgium": (50, 4),
    "netherlands": (53, 7), "finland": (61, 27), "warsaw": (52, 21), "taiwan": (24, 121),
    "delhi": (29, 77), "washington-state": (47, -120), "texas": (29, -98), "toronto": (44, -79),
    "illinois": (42, -88), "arizona": (33, -112), "wyoming": (41, -105),
}  # fmt: skip
REGIONS = {
    "aws": {
        "us-east-1": "virginia", "us-east-2": "ohio", "us-west-1": "california",
        "us-west-2": "oregon", "ca-central-1": "montreal", "ca-west-1": "calgary",
        "sa-east-1": "sao-paulo", "eu-west-1": "dublin", "eu-west-2": "london",
        "eu-west-3": "paris", "eu-central-1": "frankfurt", "eu-central-2": "zurich",
        "eu-north-1": "stockholm", "eu-south-1": "milan", "eu-south-2": "spain",
        "ap-northeast-1": "tokyo", "ap-northeast-2": "seoul", "ap-northeast-3": "osaka",
        "ap-southeast-1": "singapore", "ap-southeast-2": "sydney", "ap-southeast-3": "jakarta",
        "ap-southeast-4": "melbourne", "ap-south-1": "mumbai", "ap-south-2": "hyderabad",
        "ap-east-1": "hong-kong", "me-south-1": "bahrain", "af-south-1": "cape-town",
    },
    "gcp": {
        "us-central1": "iowa", "us-east1": "south-carolina", "us-east4": "virginia",
        "us-east5": "ohio", "us-south1": "dallas", "us-west1": "oregon",
        "us-west2": "los-angeles", "us-west3": "salt-lake-city", "us-west4": "las-vegas",
        "northamerica-northeast1": "montreal", "northamerica-northeast2": "toronto",
        "southamerica-east1": "sao-paulo", "europe-west1": "belgium", "europe-west2": "london",
        "europe-west3": "frankfurt", "europe-west4": "netherlands", "europe-west6": "zurich",
        "europe-west8": "milan", "europe-west9": "paris", "europe-north1": "finland",
        "europe-central2": "warsaw", "asia-east1": "taiwan", "asia-east2": "hong-kong",
        "asia-northeast1": "tokyo", "asia-northeast2": "osaka", "asia-northeast3": "seoul",
        "asia-south1": "mumbai", "asia-south2": "delhi", "asia-southeast1": "singapore",
        "asia-southeast2": "jakarta", "australia-southeast1": "sydney",
        "australia-southeast2": "melbourne",
    },
    "azure": {
        "eastus": "virginia", "eastus2": "virginia", "centralus": "iowa",
        "northcentralus": "illinois", "southcentralus": "texas", "westus": "california",
        "westus2": "washington-state", "westus3": "arizona", "westcentralus": "wyoming",
        "canadacentral": "toronto", "brazilsouth": "sao-paulo", "northeurope": "dublin",
        "westeurope": "netherlands", "uksouth": "london", "francecentral": "paris",
        "germanywestcentral": "frankfurt", "switzerlandnorth": "zurich",
        "swedencentral": "stockholm", "italynorth": "milan", "polandcentral": "warsaw",
        "japaneast": "tokyo", "japanwest": "osaka", "koreacentral": "seoul",
        "southeastasia": "singapore", "eastasia": "hong-kong", "australiaeast": "sydney",
        "centralindia": "mumbai", "southafricanorth": "cape-town",
    },
}  # fmt: skip

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
    cloud, _, name = region.partition("/")
    place = REGIONS.get(cloud, {}).get(name)
    return None if place is None else _PLACES[place]


def estimated_rtt_s(here: tuple[float, float], there: tuple[float, float]) -> float:
    """Return a guess of the round trip between two positions in seconds, along a great circle."""
    a, b = (math.radians(here[0]), math.radians(there[0]))
    turn = math.radians(there[1] - here[1])
    part = math.sin((b - a) / 2) ** 2 + math.cos(a) * math.cos(b) * math.sin(turn / 2) ** 2
    km = 2 * _EARTH_KM * math.asin(math.sqrt(min(1.0, part)))
    return _ACCESS_S + 2 * km * _DETOUR / _FIBRE_KM_PER_S
