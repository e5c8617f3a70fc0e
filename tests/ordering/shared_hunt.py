"""Look through thousands of runs of robots that share a service for one that goes wrong.

    python -m tests.ordering.shared_hunt FIRST COUNT [narrow]

As `test_shared_simulated`, by other seeds and for longer. A run that goes wrong is named with its
seed, and makes the whole fail.
"""

from __future__ import annotations

import random
import sys
from collections import Counter

from fogft.core import shared_sequencer
from fogft.ordering import catching_up, lag
from tests.linearizability import counter, key_value
from tests.ordering.service_world import ask_counter, ask_key_value
from tests.ordering.shared_world import SharedWorld
from tests.ordering.test_shared_simulated import ALL_KINDS, drive


def run(seed: int, seen: Counter[str]) -> None:
    """Do one run.

    Raises:
        AssertionError: It went wrong.
    """
    source = random.Random(seed)
    kinds = [(ask_counter, counter, 0), (ask_key_value, key_value, ())]
    questions, step, start = source.choice(kinds)
    world = SharedWorld(
        step, start, source, robots=source.randint(2, 3), replicas=source.choice([3, 3, 5]),
        log_entries=source.choice([8, 64]),
    )  # fmt: skip
    assert world.settle(3000), "it never began"
    faults = source.choice([0.0, 0.003, 0.01])
    drive(world, questions, 1500, faults, ALL_KINDS)
    world.heal()
    rested = world.settle(6000)
    assert rested or faults, "somebody never caught up"
    seen["runs"] += 1
    seen["asked"] += world.asked
    seen["terms"] += world.moved
    world.check()
    seen["answered"] += sum(call.answered for call in world.history)


def main(first: int, count: int, *narrow: str) -> int:
    """Return how many runs went wrong."""
    if narrow:
        lag.LIMIT, catching_up.WINDOW, shared_sequencer.GONE_AFTER_S = 3, 2, 0.2
    seen: Counter[str] = Counter()
    wrong = 0
    for seed in range(first, first + count):
        try:
            run(seed, seen)
        except AssertionError as error:
            wrong += 1
            print(f"seed {seed}: {str(error)[:300]}", flush=True)
    print(", ".join(f"{number} {what}" for what, number in seen.items()), f"- {wrong} wrong")
    return min(wrong, 1)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:]))
