"""Is a simulation that looks only now and then the same as one that looks every second?

    python -m tests.simulation.looks [FIRST] [COUNT] [DAYS]

tries pools and markets by seed, prints where the histories part, and exits with 1 if any do.
"""

from __future__ import annotations

import sys
from itertools import zip_longest

from fogft.planning.observed.history import Event
from fogft.simulation.comparison import policies, unlogged
from fogft.simulation.managed import Managed
from fogft.simulation.world import World
from tests.simulation.markets import EveryTick, any_scenario


def events(seed: int, days: float, *, every_tick: bool) -> tuple[list[Event], int]:
    """Return what happens to a pool, and how often its manager looked."""
    wanted = any_scenario(seed, days)
    world = World(wanted.market(seed), seed=seed, length_s=wanted.length_s)
    pool = policies(wanted)["fogft"](world)
    assert isinstance(pool, Managed)
    with unlogged():
        world.run(EveryTick(pool) if every_tick else pool)
    return pool.store.events, world.asked


def main(first: int = 0, count: int = 20, days: float = 0.25) -> int:
    """Compare so many, and return how many differ."""
    wrong = 0
    for seed in range(first, first + count):
        jumping, looks = events(seed, days, every_tick=False)
        ticking, ticks = events(seed, days, every_tick=True)
        parted = next((pair for pair in zip_longest(jumping, ticking) if pair[0] != pair[1]), None)
        wrong += parted is not None
        told = f"now and then: {parted[0]}\n  every second: {parted[1]}" if parted else "the same"
        print(f"{seed}: {len(ticking)} events, {looks} looks for {ticks}: {told}", flush=True)
    return wrong


if __name__ == "__main__":
    given = [float(text) for text in sys.argv[1:]]
    whole = [int(number) for number in given[:2]]
    sys.exit(bool(main(*whole, *given[2:])))
