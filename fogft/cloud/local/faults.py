"""Injected faults, stored in files that both sides can read at any time.

A fault with a duration stores its deadline (seconds since the epoch), so it ends by itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from fogft import disk
from fogft.model.plain import Moment, to_plain

FILE = "faults.json"


@dataclass(frozen=True)
class LinkFaults:
    """Faults of the network path to one machine. Without a deadline (None) they last."""

    delay_s: Moment = 0.0  # added to all traffic, each way
    rate_bytes_per_s: Moment | None = None  # the limit, each way
    slow_until: float | None = None  # when delay and rate end
    blackhole: bool = False  # nothing passes, but connections stay
    blackhole_until: float | None = None

    def at(self, now: float) -> LinkFaults:
        """Return the faults active at a time."""
        black = self.blackhole and (self.blackhole_until is None or now < self.blackhole_until)
        if self.slow_until is not None and now >= self.slow_until:
            return LinkFaults(blackhole=black)
        return replace(self, blackhole=black)


@dataclass(frozen=True)
class CloudFaults:
    """Faults in locations: outages and capacity limits."""

    outages: Mapping[str, float | None] = field(default_factory=dict)  # when each ends; None: never
    capacity: Mapping[str, int] = field(default_factory=dict)  # instead of the catalogue's numbers

    def out(self, now: float) -> list[str]:
        """Return the locations with an outage at a time."""
        return sorted(p for p, until in self.outages.items() if until is None or now < until)


def read_link(path: Path) -> LinkFaults:
    """Return a machine's link faults; none where there is no file."""
    return disk.read_as(LinkFaults, path) or LinkFaults()


def read_cloud(root: Path) -> CloudFaults:
    """Return the faults of locations; none where there is no file."""
    return disk.read_as(CloudFaults, root / FILE) or CloudFaults()


def write(path: Path, faults: LinkFaults | CloudFaults) -> None:
    """Replace a file's faults. Raises StateError: it cannot be written."""
    disk.write_json(path, to_plain(faults), durable=False)
