"""Hints for keys that were moved, renamed or removed. Pure."""

from fogft.model.choices import (
    AvailabilitySpec,
    FallbackSpec,
    OnDemandSpec,
    PlacementSpec,
    ScheduleSpec,
)
from fogft.model.keys import keys_of
from fogft.model.spec import HealthSpec, PoolSpec, ServiceSpec
from fogft.model.state import StateSpec
from fogft.model.topology import Gateway, RobotRoute, Topology

TASK_PLACES = ("run", "setup", "resources", "workdir", "envs")
Hint = tuple[str, str]  # the problem with a key, and what to do

_AUTOSCALE = {
    "autoscale": (
        "is not supported yet",
        "remove it: set the number of replicas with `fogft scale` or `schedule`",
    )
}
_DEFAULT_IS_RIGHT = "is no longer a key", "remove it: the default is right"
_OWN_POOL = (
    "is not a key of a service",
    "put this service into its own pool, with that many replicas",
)


def _renamed(name: str, instead: str = "") -> Hint:
    return f"is now called `{name}`", f"write {instead or 'that'}"


HINTS: dict[type, dict[str, Hint]] = {
    PoolSpec: {
        **_AUTOSCALE,
        "orphan_after_s": _renamed("unmanaged_max_hours", "that, in hours"),
    },
    ServiceSpec: {
        **_AUTOSCALE,
        "hedging_budget": _DEFAULT_IS_RIGHT,
        "replicas": _OWN_POOL,
        "min_replicas": _OWN_POOL,
        "uplinks": _renamed("uplink_policy", "`advanced: {uplink_policy: ...}`"),
        "fallback": _renamed("fallback_service", "`fallback_service: {name: ...}`"),
    },
    FallbackSpec: {
        "service": _renamed("name", "`fallback_service: {name: ...}`"),
        "limit_s": _DEFAULT_IS_RIGHT,
    },
    AvailabilitySpec: {"correlation": _DEFAULT_IS_RIGHT},
    PlacementSpec: {"price_weight": ("is no longer a key", "set `latency_weight` in proportion")},
    ScheduleSpec: {"prelaunch_s": _DEFAULT_IS_RIGHT},
    StateSpec: {
        "shared": (
            "is no longer a key: a service with `state` is for one robot",
            "for several robots, remove `state` and keep the service's state in a replicated "
            "store, such as etcd; docs/how-to/state.md shows how",
        )
    },
    Topology: {"through": _renamed("default_gateways")},
    Gateway: {"through": _renamed("upstream")},
    RobotRoute: {"through": _renamed("gateways")},
}


def places(cls: type | None) -> dict[str, str]:
    """Return the right place for each key that is not allowed in a map of this class."""
    here = {entry.name for entry in keys_of(cls) if not entry.key.advanced} if cls else set()
    found: dict[str, str] = {}
    for home, where in (
        (OnDemandSpec, "under `fogft.on_demand`"),
        (HealthSpec, "under `fogft.health`"),
        (ServiceSpec, "in a service, under `fogft.services`"),
        (PoolSpec, "under `fogft`"),
    ):
        for entry in keys_of(home):
            found[entry.name] = f"{where}, in `advanced`" if entry.key.advanced else where
    found |= dict.fromkeys(TASK_PLACES, "at the top level of the file")
    elsewhere = found.keys() - here - {"name", "type", "fallback"}
    return {name: where for name, where in found.items() if name in elsewhere}
