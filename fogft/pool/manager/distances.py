"""Round trips from the robot to regions, from the best known source.

The round trip of a link only refines a distance that is known otherwise: without that rule, a
region with a replica would look closer than regions without a known distance.

Not here: the use of round trips (`fogft.planning.listing`).
"""

import csv
import functools
import math
import socket
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

from fogft import disk, template_files
from fogft.errors import StateError
from fogft.model.choices import PlacementSpec
from fogft.model.plain import Moment, stored, to_plain, within
from fogft.model.replica import LinkState, Observed, Offer
from fogft.model.spec import PoolSpec
from fogft.process import on_thread

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
FRESH_S = 86_400.0
RETRY_S = 900.0
CONNECTS = 3
CONNECT_LIMIT_S = 2.0
REMEMBERED_RTTS = 31


def endpoint(region: str) -> tuple[str, int] | None:
    """Return the host and port of an endpoint in a ``cloud/region``; None if none is known."""
    cloud, _, name = region.partition("/")
    pattern = _ENDPOINTS.get(cloud)
    return None if pattern is None or not name else (pattern.format(region=name), PORT)


@functools.cache
def positions() -> dict[str, tuple[float, float]]:
    """Return latitude and longitude in degrees of all known regions, by ``cloud/region``."""
    lines = template_files.read_text("regions.csv").splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    return {row["region"]: (float(row["latitude"]), float(row["longitude"])) for row in rows}


def estimated_rtt_s(here: tuple[float, float], there: tuple[float, float]) -> float:
    """Return an estimated round trip between two positions in seconds, along a great circle."""
    a, b = (math.radians(here[0]), math.radians(there[0]))
    turn = math.radians(there[1] - here[1])
    part = math.sin((b - a) / 2) ** 2 + math.cos(a) * math.cos(b) * math.sin(turn / 2) ** 2
    km = 2 * _EARTH_KM * math.asin(math.sqrt(min(1.0, part)))
    return _ACCESS_S + 2 * km * _DETOUR / _FIBRE_KM_PER_S


@dataclass(frozen=True)
class Distance:
    """A round trip and its source: ``pool file``, ``links``, ``measured`` or ``estimated``.

    `as_of` is when it was measured, in seconds since the epoch; 0 if that does not apply.
    """

    rtt_s: Annotated[float, within(1e-9, 60)]
    source: str = "measured"
    as_of: Moment = 0.0


def connect_time(host: str, port: int) -> float:
    """Return how long a TCP connect takes, in seconds: about one round trip."""
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    times = []
    for _ in range(CONNECTS):
        family, kind, protocol, _, address = found[0]
        with socket.socket(family, kind, protocol) as one:
            one.settimeout(CONNECT_LIMIT_S)
            began = time.perf_counter()
            one.connect(address)
            times.append(time.perf_counter() - began)
    return min(times)


@dataclass(eq=False)
class Latencies:
    """This machine's round trips by ``cloud/region``, cached in a file."""

    file: Path
    _: KW_ONLY
    clock: Callable[[], float] = time.time

    def measured(self) -> Mapping[str, Distance]:
        """Return the measured round trips, whatever their age. A damaged file counts as empty."""
        try:
            return stored(dict[str, Distance], disk.read_json(self.file) or {}, "")
        except StateError:
            return {}

    def stale(self, regions: Collection[str]) -> list[str]:
        """Return the regions to measure: not measured yet, over a day ago, or in the future."""
        kept, now = self.measured(), self.clock()
        return sorted(
            region
            for region in regions
            if endpoint(region) is not None
            and not (region in kept and 0 <= now - kept[region].as_of < FRESH_S)
        )

    def measure(self, regions: Iterable[str]) -> Mapping[str, str]:
        """Measure regions in parallel and store the results; return failures with reasons."""
        wanted = [(r, e) for r in sorted(set(regions)) if (e := endpoint(r)) is not None]
        if not wanted:
            return {}
        now, failed = self.clock(), {}
        found: dict[str, Distance] = {}
        with ThreadPoolExecutor(min(8, len(wanted)), "latency") as pool:
            for (region, _), result in zip(wanted, pool.map(self._try, wanted), strict=True):
                if isinstance(result, float):
                    found[region] = Distance(result, "measured", now)
                else:
                    failed[region] = result
        if found:
            disk.make_folder(self.file.parent)
            with disk.locked(self.file.with_suffix(".lock")):  # other managers measure, too
                kept = {**self.measured(), **found}
                disk.write_json(self.file, to_plain(kept), durable=False)
        return failed

    def known(
        self, regions: Iterable[str], placement: PlacementSpec, links: Mapping[str, float]
    ) -> dict[str, Distance]:
        """Return the best known round trip of each region that has one."""
        measured, out = self.measured(), {}
        for region in regions:
            told = placement.rtt_s.get(region, placement.rtt_s.get(region.split("/")[0]))
            if told is not None:
                out[region] = Distance(told, "pool file")
                continue
            found = measured.get(region)
            if not found and placement.robot_at and (there := positions().get(region)):
                found = Distance(estimated_rtt_s(placement.robot_at, there), "estimated")
            if found is not None:
                out[region] = Distance(links[region], "links") if region in links else found
        return out

    def _try(self, wanted: tuple[str, tuple[str, int]]) -> float | str:
        try:
            return connect_time(*wanted[1])
        except OSError as error:
            return str(error)


class Distances:
    """The manager's round trips for its planner. Measures in the background."""

    def __init__(self, latencies: Latencies) -> None:
        self._latencies = latencies
        self._looked_at = -math.inf
        self._rtts: dict[str, deque[float]] = {}
        self._busy = threading.Lock()

    def __call__(self, spec: PoolSpec, seen: Observed) -> Mapping[str, float]:
        """Return ``cloud/region`` -> round trip in seconds, where it is known."""
        regions = regions_of(seen.offers)
        now = time.monotonic()
        if regions and now - self._looked_at >= RETRY_S:
            self._looked_at = now
            on_thread(self._renew, regions)
        known = self._latencies.known(regions, spec.placement, self._from_links(seen))
        return {region: distance.rtt_s for region, distance in known.items()}

    def _renew(self, regions: Collection[str]) -> None:
        if self._busy.acquire(blocking=False):
            try:
                self._latencies.measure(self._latencies.stale(regions))
            finally:
                self._busy.release()

    def _from_links(self, seen: Observed) -> dict[str, float]:
        """Return the median of the last round trips by region: one slow probe changes nothing."""
        where = {m.id: f"{m.placement.cloud}/{m.placement.region}" for m in seen.machines or ()}
        for link in seen.links or ():
            if link.rtt_s is not None and link.state is LinkState.UP and link.id in where:
                kept = self._rtts.setdefault(where[link.id], deque(maxlen=REMEMBERED_RTTS))
                kept.append(link.rtt_s)
        return {region: statistics.median(kept) for region, kept in self._rtts.items()}


def regions_of(offers: Iterable[Offer]) -> set[str]:
    """Return the ``cloud/region`` of offers."""
    return {f"{o.placement.cloud}/{o.placement.region}" for o in offers}
