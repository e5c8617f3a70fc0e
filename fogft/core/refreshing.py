"""Whom a cloud with a memory is asked about: replicas whose links have fallen silent. Pure.

Such a cloud's list may still show what was preempted, so the silence of a link is a reason to
look; and to look only, since the answer may well be that the machine is there. Asked at
once, then less and less often while nothing changes, and for the whole pool when all links
are silent: losing every replica together looks like a dead uplink until the cloud has told.

Owns: who is due.
Not here: asking (`fogft.cloud`), on a thread of its own (`fogft.pool.operations`).
"""

from __future__ import annotations

from fogft.core.health import was_heard
from fogft.core.history import History
from fogft.core.model import LinkState, MachinePhase, Observed, ReplicaId

FIRST_PAUSE_S = 4.0
LONGEST_PAUSE_S = 60.0
NEVER_HEARD_PAUSE_S = 30.0


class Silent:
    """Remembers when each silent replica was asked about. One thread."""

    def __init__(self) -> None:
        self._next: dict[ReplicaId, tuple[float, float]] = {}

    def due(self, observed: Observed, history: History) -> list[ReplicaId]:
        """Return whom to ask about now; they count as asked."""
        silent = _silent(observed, history)
        self._next = {id: known for id, known in self._next.items() if id in silent}
        out: list[ReplicaId] = []
        for id, first_pause_s in silent.items():
            first_at = observed.now + (first_pause_s if first_pause_s > FIRST_PAUSE_S else 0.0)
            at, pause_s = self._next.setdefault(id, (first_at, first_pause_s))
            if observed.now >= at:
                out.append(id)
                later_s = min(LONGEST_PAUSE_S, 2 * pause_s)
                self._next[id] = (observed.now + pause_s, later_s)
        return out


def _silent(observed: Observed, history: History) -> dict[ReplicaId, float]:
    """Return the machines that should answer and do not, each with its first pause."""
    links = {link.id: link for link in observed.links or ()}
    out: dict[ReplicaId, float] = {}
    for machine in observed.machines or ():
        link = links.get(machine.id)
        if machine.phase is not MachinePhase.RUNNING or machine.id in observed.ending:
            continue
        if link is not None and link.state is not LinkState.UP:
            record = history.record(machine.id.slot, machine.id.generation)
            heard = was_heard(link, record)
            out[machine.id] = FIRST_PAUSE_S if heard else NEVER_HEARD_PAUSE_S
    return out
