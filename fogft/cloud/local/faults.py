"""Faults on purpose, as files that both sides can read at any time.

A fault with a duration carries its deadline (seconds since the epoch), so it ends by
itself, whoever set it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from fogft import disk
from fogft.errors import StateError

FILE = "faults.json"


@dataclass(frozen=True)
class LinkFaults:
    """What is wrong with the path to one machine.

    Attributes:
        delay_s: Added to everything, each way.
        rate_bytes_per_s: The most that passes each way; None for no limit.
        slow_until: When these two end; None for never.
        blackhole: Nothing passes, but connections stay.
        blackhole_until: When that ends; None for never.
        resets: Counts up; each new value resets all connections once.
    """

    delay_s: float = 0.0
    rate_bytes_per_s: float | None = None
    slow_until: float | None = None
    blackhole: bool = False
    blackhole_until: float | None = None
    resets: int = 0

    def at(self, now: float) -> LinkFaults:
        """Return what is in force at a time."""
        slow = self.slow_until is None or now < self.slow_until
        black = self.blackhole and (self.blackhole_until is None or now < self.blackhole_until)
        return LinkFaults(
            delay_s=self.delay_s if slow else 0.0,
            rate_bytes_per_s=self.rate_bytes_per_s if slow else None,
            blackhole=black,
            resets=self.resets,
        )


@dataclass(frozen=True)
class CloudFaults:
    """What is wrong with locations.

    Attributes:
        outages: Location -> when it ends; None for never.
        capacity: Location -> how many machines fit, instead of the catalogue's number.
    """

    outages: Mapping[str, float | None] = field(default_factory=dict)
    capacity: Mapping[str, int] = field(default_factory=dict)

    def out(self, now: float) -> list[str]:
        """Return the locations that are out at a time."""
        return sorted(p for p, until in self.outages.items() if until is None or now < until)


def read_link(path: Path) -> LinkFaults:
    """Return a machine's link faults; none where there is no file.

    Raises:
        StateError: The file is damaged.
    """
    raw = disk.read_json(path)
    try:
        faults = LinkFaults(**(raw or {}))
        numbers = (faults.delay_s, faults.rate_bytes_per_s or 1.0)
        if not all(math.isfinite(n) and n >= 0 for n in numbers):
            raise ValueError(numbers)
    except (TypeError, ValueError) as error:
        raise StateError(f"`{path}` is damaged: {error}") from error
    return faults


def read_cloud(root: Path) -> CloudFaults:
    """Return the faults of locations; none where there is no file.

    Raises:
        StateError: The file is damaged.
    """
    raw: Any = disk.read_json(root / FILE)
    try:
        return CloudFaults(**(raw or {}))
    except TypeError as error:
        raise StateError(f"`{root / FILE}` is damaged: {error}") from error


def write(path: Path, faults: LinkFaults | CloudFaults) -> None:
    """Replace what stands in a file. Raises StateError: it cannot be written."""
    disk.write_json(path, asdict(faults), durable=False)
