"""Which fault comes when, on whom and for how long, from a seed. Pure.

Faults come one after the other, with time between them to heal: so at least one path is good
at every moment. In each round every kind comes once, in another order.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

KINDS = (
    "kill",
    "freeze",
    "blackhole",
    "slow",
    "starve",
    "address change",
    "rendezvous death",
    "gateway death",
    "uplink loss",
    "certificate rotation",
    "all killed",
    "suspend",
    "no descriptors",
    "clock set",
    "new uplink address",
    "long suspend",
)
NIGHTLY = ("long suspend",)  # a minute each
SHORTEST_S, LONGEST_S = 1.5, 4.0


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        kind: One of `KINDS`.
        victim: Which of the things of that kind, as a number.
        lasts_s: For how long, in seconds, where it ends by itself.
    """

    kind: str
    victim: int
    lasts_s: float


def faults(seed: int, kinds: Sequence[str] = KINDS) -> Iterator[Fault]:
    """Return faults without end."""
    chance = random.Random(seed)
    while True:
        for kind in chance.sample(list(kinds), len(kinds)):
            lasts_s = round(chance.uniform(SHORTEST_S, LONGEST_S), 2)
            yield Fault(kind, chance.randrange(1 << 16), lasts_s)
