"""`shared: true` in a service's `state`: how many replicas such a pool needs. Pure.

Owns: the number, and its check. Not here: what it is for (`shared_sequencer`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from fogft.model.spec import PoolSpec
from fogft.poolfile.tree import Section

FEWEST = 3  # with two, the loss of one leaves no majority, and nobody can put that right


def fewest_replicas(spec: PoolSpec) -> int:
    """Return how many replicas the pool has at the least, at any time of the week."""
    windows = spec.schedule.windows if spec.schedule else ()
    return min([spec.replicas, *(w.replicas for w in windows if w.replicas is not None)])


def with_founders(spec: PoolSpec, sections: Sequence[Section]) -> PoolSpec:
    """Return the pool with what its shared services need to begin.

    Args:
        spec: The pool.
        sections: Its first services, as the file has them.

    Raises:
        SpecError: It has too few replicas for a shared service.
    """
    fewest = fewest_replicas(spec)
    services = list(spec.services)
    for at, section in enumerate(sections):
        state = services[at].state
        if state is None or not state.shared:
            continue
        if fewest < FEWEST:
            where = " in a window of `schedule`" if fewest < spec.replicas else ""
            raise section.section("state").error(
                "shared",
                f"needs {FEWEST} replicas or more, and the pool has {fewest}{where}: "
                "with fewer, the loss of one would end the service",
                f"write `replicas: {FEWEST}` (or 5, to bear the loss of two at once)",
            )
        services[at] = replace(services[at], state=replace(state, founders=fewest))
    return replace(spec, services=tuple(services))
