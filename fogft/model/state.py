"""The two services that save and restore a service's state."""

from dataclasses import dataclass

from fogft.model.keys import Map, key
from fogft.model.ros_names import field_path, service_name, service_type

SNAPSHOT_TYPE = "nav_msgs/srv/GetMap"
RESTORE_TYPE = "nav_msgs/srv/SetMap"
FIELD = "map.data"
_HINT = "write `state: {snapshot: /svc/get_state, restore: /svc/set_state}`"


@dataclass(frozen=True)
class StateService:
    """A service that carries a state."""

    name: str = key(
        service_name("write a name such as `/svc/get_state`"),
        "Name of the service.",
    )
    type: str = key(
        service_type("write `{name: ..., type: ..., field: ...}`"),
        "Its type.",
        default="",
        usual=f"`{SNAPSHOT_TYPE}`, `{RESTORE_TYPE}`",
    )
    field: str = key(
        field_path(f"write a path such as `field: {FIELD}`"),
        "The text or byte field that holds the state: of the response for a snapshot, of the "
        "request for a restore.",
        default="",
        usual=f"`{FIELD}`",
    )


@dataclass(frozen=True)
class StateSpec:
    """How a service's state is saved and restored."""

    snapshot: StateService = key(
        Map(StateService, _HINT, short=("name",)),
        "The service that returns the whole state, called between two requests. A name alone "
        f"stands for one of type `{SNAPSHOT_TYPE}` with the state in `{FIELD}`.",
    )
    restore: StateService = key(
        Map(StateService, _HINT, short=("name",)),
        "The service that replaces the whole state. A name alone stands for one of type "
        f"`{RESTORE_TYPE}`.",
    )
