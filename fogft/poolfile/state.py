"""The `state` of a service: by which two services its state is taken and given. Pure.

Owns: the values, how a pool file and a configuration file write them.
Not here: the types themselves (`fogft.ros.state_bytes`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fogft.model import ros_names
from fogft.poolfile.tree import Section, shown

SNAPSHOT_TYPE = "nav_msgs/srv/GetMap"
RESTORE_TYPE = "nav_msgs/srv/SetMap"
FIELD = "map.data"
STATE_KEYS = ("snapshot", "restore")
STATE_SERVICE_KEYS = ("name", "type", "field")
_HINT = "write `state: {snapshot: /svc/get_state, restore: /svc/set_state}`"
_SHARED = "is no key any more: a service with `state` is for one robot"
_SHARED_HINT = (
    "for several robots remove `state` and let the service keep its state in a replicated store, "
    "such as etcd; docs/state.md shows how"
)


@dataclass(frozen=True)
class StateService:
    """A service that carries a state.

    Attributes:
        field: Where the state is: a text or byte field, by its path; of the response for
            a snapshot, of the request for a restore.
    """

    name: str
    type: str
    field: str


@dataclass(frozen=True)
class StateSpec:
    """How a service's state is taken and given."""

    snapshot: StateService
    restore: StateService

    def to_plain(self) -> dict[str, Any]:
        """Return it as a configuration file has it."""
        return {"snapshot": vars(self.snapshot).copy(), "restore": vars(self.restore).copy()}


def from_plain(raw: Mapping[str, Any] | None) -> StateSpec | None:
    """Return the `state` of a configuration file; None where there is none.

    Raises:
        KeyError: Something is missing.
        TypeError: It is of the wrong form.
    """
    if raw is None:
        return None
    snapshot, restore = (
        StateService(*(str(raw[end][k]) for k in STATE_SERVICE_KEYS))
        for end in ("snapshot", "restore")
    )
    return StateSpec(snapshot, restore)


def read_state(service: Section) -> StateSpec | None:
    """Return the `state` of a service in a pool file; None where there is none.

    Raises:
        SpecError: The first mistake.
    """
    if "state" not in service.children:
        return None
    state = service.section("state", _HINT)
    if "shared" in state.children:
        raise state.error("shared", _SHARED, _SHARED_HINT, at_key=True)
    state.only(STATE_KEYS)
    for key in ("snapshot", "restore"):
        if key not in state.children:
            raise state.error(key, "is missing", _HINT)
    return StateSpec(_end(state, "snapshot", SNAPSHOT_TYPE), _end(state, "restore", RESTORE_TYPE))


def _end(state: Section, key: str, default_type: str) -> StateService:
    if not isinstance(state.children[key].value, Mapping):
        return StateService(_name(state, key), default_type, FIELD)
    end = state.section(key)
    end.only(STATE_SERVICE_KEYS)
    hint = f"write `{key}: {{name: ..., type: ..., field: ...}}`"
    if ("type" in end.children) != ("field" in end.children):
        missing = "field" if "type" in end.children else "type"
        raise end.error(missing, "is missing: type and field belong together", hint)
    type_name = end.text("type", hint, default=default_type)
    if not ros_names.is_service_type(type_name):
        meant = ros_names.suggested_service_type(type_name)
        what = f"{shown(type_name)} is not a service type"
        raise end.error("type", what, f"did you mean `{meant}`?" if meant else hint)
    path = end.text("field", hint, default=FIELD)
    if not all(map(ros_names.is_field_name, path.split("."))):
        what = f"{shown(path)} is not the path of a field"
        raise end.error("field", what, f"write a path such as `field: {FIELD}`")
    return StateService(_name(end, "name"), type_name, path)


def _name(section: Section, key: str) -> str:
    written = section.text(key, "write a service's name, such as `/svc/get_state`")
    try:
        return ros_names.absolute_service_name(written)
    except ValueError as error:
        what = f"{shown(written)} is not a service name: {error}"
        raise section.error(key, what, "write a name such as `/svc/get_state`") from None
