"""Which replicas a caching cloud is asked about: those whose links fell silent. Pure.

Such a cloud's list may still show what was preempted, so the silence of a link is a reason to
look; and to look only, since the answer may well be that the machine is there. So nobody waits
until a link is suspect: a probe whose answer is late is enough. Asked at once, then less and
less often while nothing changes, and for the whole pool when all links are silent: losing every
replica together looks like a dead uplink until the cloud has told.

Owns: who is due.
Not here: asking (`fogft.cloud`), on a thread of its own (`fogft.pool.manager.operations`).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from fogft.model.replica import LinkReport, LinkState, MachinePhase, Observed, ReplicaId
from fogft.planning.observed.health import was_heard
from fogft.planning.observed.history import History

FIRST_PAUSE_S = 4.0
LONGEST_PAUSE_S = 60.0
DOUBTED_PAUSE_S = 15.0  # whoever is lost after a doubt is asked about at once again
NEVER_HEARD_PAUSE_S = 30.0
FALSE_ALARM_REMEMBERED_S = 600.0
"""A link that often hesitates and then answers costs a question now and then, no more."""


class _Silence(Enum):
    NEVER_HEARD = "never heard"
    DOUBTED = "doubted"  # still up: a probe's answer is late
    LOST = "lost"


@dataclass
class _Asked:
    """When a replica may be asked about, and the pause after that."""

    silence: _Silence
    next_at: float
    pause_s: float


class Silent:
    """Remembers when each silent replica was asked about. One thread."""

    def __init__(self) -> None:
        self._asked: dict[ReplicaId, _Asked] = {}

    def due(self, observed: Observed, history: History) -> list[ReplicaId]:
        """Return the replicas to ask about now; they count as asked."""
        silent = _silent(observed, history)
        self._asked = {
            id: asked
            for id, asked in self._asked.items()
            if id in silent or _is_remembered(asked, observed.now)
        }
        return [id for id, silence in silent.items() if self._is_due(id, silence, observed.now)]

    def _is_due(self, id: ReplicaId, silence: _Silence, now: float) -> bool:
        asked = self._asked.get(id)
        if asked is None or (silence is _Silence.LOST and asked.silence is not _Silence.LOST):
            asked = self._asked[id] = _first(silence, now)
        if now < asked.next_at:
            return False
        asked.next_at = now + asked.pause_s
        asked.pause_s = min(LONGEST_PAUSE_S, 2 * asked.pause_s)
        return True


def _first(silence: _Silence, now: float) -> _Asked:
    if silence is _Silence.NEVER_HEARD:
        return _Asked(silence, now + NEVER_HEARD_PAUSE_S, NEVER_HEARD_PAUSE_S)
    doubted = silence is _Silence.DOUBTED
    return _Asked(silence, now, DOUBTED_PAUSE_S if doubted else FIRST_PAUSE_S)


def _is_remembered(asked: _Asked, now: float) -> bool:
    """Whether one that answers again keeps its pause."""
    recent = now - asked.next_at < FALSE_ALARM_REMEMBERED_S
    return asked.silence is _Silence.DOUBTED and recent


def _silent(observed: Observed, history: History) -> dict[ReplicaId, _Silence]:
    """Return the machines that should answer and do not, each with how it is silent."""
    links = {link.id: link for link in observed.links or ()}
    out: dict[ReplicaId, _Silence] = {}
    for machine in observed.machines or ():
        link = links.get(machine.id)
        if machine.phase is not MachinePhase.RUNNING or machine.id in observed.ending:
            continue
        if link is not None and (link.doubted or link.state is not LinkState.UP):
            record = history.record(machine.id.slot, machine.id.generation)
            out[machine.id] = _how(link, heard=was_heard(link, record))
    return out


def _how(link: LinkReport, *, heard: bool) -> _Silence:
    if link.state is LinkState.UP:
        return _Silence.DOUBTED
    return _Silence.LOST if heard else _Silence.NEVER_HEARD
