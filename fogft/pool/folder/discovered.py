"""`discovered.json`: the services of a pool whose file lists none, kept across restarts.

Owns: the file, and which types can be offered on this machine.
Not here: how it grows (`fogft.planning.observed.services`).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from fogft import disk
from fogft.errors import StateError
from fogft.model import ros_names
from fogft.model.choices import Speaks
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Observed
from fogft.model.spec import PoolSpec
from fogft.planning.observed.services import Discovered, grown, offered


def read(path: Path) -> Discovered:
    """Return what was found; nothing where the file is missing or damaged."""
    try:
        raw = disk.read_json(path)
        services = {str(name): str(kind) for name, kind in raw["services"].items()}
        return Discovered(str(raw["spec_hash"]), services)
    except (StateError, KeyError, TypeError, AttributeError):
        return Discovered()


class Discovery:
    """Keeps the file of one pool. The manager's.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._known = read(path)
        self._refused: dict[tuple[str, str], str] = {}
        self.notes: list[Reason] = []

    def look(self, spec: PoolSpec, observed: Observed) -> bool:
        """Take up what replicas offer; return whether that changed the file.

        Raises:
            StateError: It cannot be written.
        """
        self.notes = []
        if spec.services:
            return False
        told = offered(spec.replica_hash, observed.machines or (), observed.links or ())
        usable = {name: kind for name, kind in told.items() if not self._refusal(spec, name, kind)}
        more = grown(self._known, spec.replica_hash, usable)
        if more == self._known:
            return False
        plain = {"spec_hash": more.spec_hash, "services": dict(more.services)}
        disk.write_json(self._path, plain)
        self._known = more
        return True

    def _refusal(self, spec: PoolSpec, name: str, kind: str) -> str:
        """Return why a service cannot be offered here; it is left out then, and noted."""
        if (name, kind) not in self._refused:
            self._refused[(name, kind)] = _check(name, kind, load=spec.rmw.robot is Speaks.RCLPY)
        why = self._refused[(name, kind)]
        if why:
            self.notes.append(Reason(Cause.NOT_OFFERED, name=name, words=why))
        return why


def _check(name: str, kind: str, *, load: bool) -> str:
    from fogft.ros.types import load_service_type, trouble

    try:
        if ros_names.absolute_service_name(name) != name:
            return "its name is not absolute"
    except ValueError as error:
        return str(error)
    return (trouble(partial(load_service_type, kind)) if load else None) or ""
