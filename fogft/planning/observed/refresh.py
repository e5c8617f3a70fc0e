"""Which replicas to query at a cloud that caches its list: those whose links are silent. Pure.

A cached list may still show preempted machines. A late reply to a probe leads to a query and to
nothing else. All silent replicas are queried, because losing every replica together looks like a
dead uplink until the cloud has answered.

Not here: asking (`fogft.cloud`), on a thread of its own (`fogft.pool.manager.operations`).
"""

from dataclasses import dataclass
from enum import Enum

from fogft.model.replica import LinkState, MachinePhase, Observed, ReplicaId
from fogft.planning.observed.health import was_heard
from fogft.planning.observed.history import History

LONGEST_PAUSE_S = 60.0
FALSE_ALARM_REMEMBERED_S = 600.0
"""So a link that often pauses and recovers costs only an occasional query."""


class _Silence(float, Enum):
    """How a replica is silent, with the first pause between queries in seconds."""

    NEVER_HEARD = 30.0
    DOUBTED = 15.0  # still up, but a reply to a probe is late; once LOST, it is queried at once
    LOST = 4.0


@dataclass
class _Asked:
    """When a replica may next be queried, and the pause after that."""

    silence: _Silence
    next_at: float
    pause_s: float


class Silent:
    """Remembers when each silent replica was queried. For one thread."""

    def __init__(self) -> None:
        self._asked: dict[ReplicaId, _Asked] = {}

    def due(self, observed: Observed, history: History) -> list[ReplicaId]:
        """Return the replicas to query now; they count as queried."""
        silent, now = _silent(observed, history), observed.now
        self._asked = {
            id: asked
            for id, asked in self._asked.items()
            if id in silent  # after a false alarm, the pause is kept for a while
            or (
                asked.silence is _Silence.DOUBTED and now - asked.next_at < FALSE_ALARM_REMEMBERED_S
            )
        }
        return [id for id, silence in silent.items() if self._is_due(id, silence, now)]

    def _is_due(self, id: ReplicaId, silence: _Silence, now: float) -> bool:
        asked = self._asked.get(id)
        if asked is None or (silence is _Silence.LOST and asked.silence is not _Silence.LOST):
            next_at = now + silence if silence is _Silence.NEVER_HEARD else now
            asked = self._asked[id] = _Asked(silence, next_at, silence.value)
        if now < asked.next_at:
            return False
        asked.next_at = now + asked.pause_s
        asked.pause_s = min(LONGEST_PAUSE_S, 2 * asked.pause_s)
        return True


def _silent(observed: Observed, history: History) -> dict[ReplicaId, _Silence]:
    """Return the machines that should answer but do not, and how each is silent."""
    links = {link.id: link for link in observed.links or ()}
    out: dict[ReplicaId, _Silence] = {}
    for machine in observed.machines or ():
        link = links.get(machine.id)
        if machine.phase is not MachinePhase.RUNNING or machine.id in observed.ending:
            continue
        if link is None or not (link.doubted or link.state is not LinkState.UP):
            continue
        if link.state is LinkState.UP:
            out[machine.id] = _Silence.DOUBTED
        else:
            heard = was_heard(link, history.record(machine.id.slot, machine.id.generation))
            out[machine.id] = _Silence.LOST if heard else _Silence.NEVER_HEARD
    return out
