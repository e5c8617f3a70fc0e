"""`discovered.json`: the services of a pool whose file lists none, kept across restarts.

Owns: the file, and which types can be offered on this machine.
Not here: how it grows (`fogft.planning.observed.services`).
"""

from dataclasses import replace
from pathlib import Path

from fogft import disk
from fogft.errors import told
from fogft.model import ros_names
from fogft.model.choices import Speaks
from fogft.model.plain import as_line, to_plain
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Observed
from fogft.model.spec import PoolSpec
from fogft.planning.observed.services import Claims, Discovered, claims, grown

_NOTED = 5  # services that are not offered


class Discovery:
    """Maintains the file of one pool. Used by the manager."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.known = disk.read_or(path, Discovered())
        self._refused: dict[tuple[str, str], str] = {}
        self._doubted: dict[str, float] = {}  # known names, and since when most do not offer them
        self.notes: list[Reason] = []

    def look(self, spec: PoolSpec, observed: Observed, wanted: int) -> bool:
        """Add the services that most replicas offer; return whether that changed the file."""
        self.notes = []
        self._doubted = {} if observed.doubt_s else self._doubted  # no time for a set clock
        if spec.services:
            return False
        told = claims(self.known, spec.replica_hash, observed, wanted)
        agreed = told.agreed()
        usable = {
            name: kind for name, kind in agreed.items() if not self._refusal(spec, name, kind)
        }
        more = self._without_doubtful(spec, told, observed.now)
        more = grown(more, spec.replica_hash, usable, told.heard)
        new = [name for name in told.outvoted() if name not in more.services]
        self.notes += [
            Reason(Cause.OUTVOTED, name=as_line(name), of=told.voters) for name in new[:_NOTED]
        ]
        if more == self.known:
            return False
        disk.write_json(self._path, to_plain(more))
        self.known = more
        return True

    def _without_doubtful(self, spec: PoolSpec, told: Claims, now: float) -> Discovered:
        """Return the known services without those that most have not offered for long."""
        known = self.known
        doubtful = told.doubtful(known) if known.spec_hash == spec.replica_hash else ()
        self._doubted = {name: self._doubted.get(name, now) for name in doubtful}
        limit_s = spec.health.start_limit_s / 2
        over = {name for name, since in self._doubted.items() if now - since > limit_s}
        if not over:
            return known
        left = {name: kind for name, kind in known.services.items() if name not in over}
        return replace(known, services=left, voters=told.heard)

    def _refusal(self, spec: PoolSpec, name: str, kind: str) -> str:
        """Return why a service cannot be offered here, and note it; empty if it can."""
        if (name, kind) not in self._refused:
            self._refused[(name, kind)] = _check(name, kind, load=spec.rmw.robot is Speaks.RCLPY)
        why = self._refused[(name, kind)]
        if not why and not ros_names.is_below(name, spec.namespace):
            why = f"it is not below `namespace`, which is `{spec.namespace}`"
        if why and len(self.notes) < _NOTED:
            self.notes.append(Reason(Cause.NOT_OFFERED, name=name, words=why))
        return why


def _check(name: str, kind: str, *, load: bool) -> str:
    from fogft.ros.types import load_service_type, trouble

    try:
        if ros_names.absolute_service_name(name) != name:
            return "its name is not absolute"
    except ValueError as error:
        return str(error)
    found = trouble(load_service_type, kind) if load else None
    return told(found) if found else ""
