"""Rules for combinations of keys in a pool file: each checks a map once its keys are read. Pure."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from fogft.model import schedule, state
from fogft.model.choices import MetricsSpec, OnDemandSpec, ScheduleSpec, WindowSpec
from fogft.model.groups import FIRST_BY_HAND
from fogft.model.names import gateway_slot
from fogft.model.spec import Advertise, HedgingMode, OnTimeout, ServiceSpec
from fogft.model.state import StateService, StateSpec
from fogft.model.topic import Origin, TopicSpec
from fogft.model.topology import Topology, find_loop
from fogft.poolfile.tree import Section, shown

DAY_END_S = 86_400
NOT_WITH_QUORUM = ("ok_field", "hedging", "cancel")
NOT_WITH_STATE = (*NOT_WITH_QUORUM, "concurrency", "quorum", "trace")
_LAST_REPLICA_PORT = 65535 - FIRST_BY_HAND


def _service(section: Section, made: ServiceSpec) -> ServiceSpec:
    _stateful(section, made)
    if made.tolerance and not section.has("quorum"):
        what = "has no effect here: answers are compared only with a `quorum`"
        raise section.error("tolerance", what, "write `quorum: 2`, or remove it")
    if section.has("quorum"):
        what = "cannot be combined with `quorum`: every replica is asked, and every answer counts"
        _apart(section, made, NOT_WITH_QUORUM, what)
    if made.cancel == made.name:
        hint = f"write the name of its cancel service, such as `cancel: {made.name}_cancel`"
        raise section.error("cancel", "is the service itself", hint)
    if made.concurrency > 1 and made.cancel:
        raise section.error(
            "concurrency",
            "must be 1 with a `cancel` service, which cannot tell requests apart",
            "remove one of the two",
        )
    _fallback(section, made)
    return made


def _stateful(section: Section, made: ServiceSpec) -> None:
    if made.state is None:
        return
    what = "cannot be combined with `state`: every replica applies every request"
    _apart(section, made, NOT_WITH_STATE, what)
    for key, value in (("freshness", "latest"), ("advertise", Advertise.WHILE_READY.value)):
        chosen = getattr(made, key)
        if chosen is not None and chosen.value == value:
            what = f"cannot be `{value}` for a service with `state`: its requests are kept in order"
            raise section.error(key, what, "remove it")
    if made.on_timeout is OnTimeout.FALLBACK:
        what = (
            "cannot be `fallback` for a service with `state`: the fallback does not have that state"
        )
        raise section.error("on_timeout", what, "write `silent` or `empty`")


def _apart(section: Section, made: ServiceSpec, keys: Sequence[str], what: str) -> None:
    for key in keys:
        if section.has(key) and not (key == "hedging" and made.hedging is HedgingMode.ALL):
            raise section.error(key, what, "remove it")


def _fallback(section: Section, made: ServiceSpec) -> None:
    key, other = "fallback_service", made.fallback
    example = f"such as `{key}: {{name: {made.name}_onboard}}`"
    if made.on_timeout is not OnTimeout.FALLBACK:
        if other is not None:
            what = "is not used: `on_timeout` is not `fallback`"
            raise section.error(key, what, "write `on_timeout: fallback`, or remove it")
        return
    if other is None:
        hint = f"name a service of the same type on the robot, {example}"
        raise section.error(key, "is missing", hint)
    below = section.section(key)
    if other.service == made.name:
        hint = f"write the name of a service on the robot, {example}"
        raise below.error("name", "is the service itself", hint)
    if other.after_s is not None and other.after_s >= made.timeout_s:
        raise below.error(
            "after_s",
            f"must be below `timeout_s`, which is {made.timeout_s:g}",
            "make it shorter, or remove it: at the deadline the fallback is asked anyway",
        )


def _state_services(section: Section, made: StateSpec) -> StateSpec:
    return StateSpec(
        _state_service(section, "snapshot", made.snapshot, state.SNAPSHOT_TYPE),
        _state_service(section, "restore", made.restore, state.RESTORE_TYPE),
    )


def _state_service(section: Section, key: str, made: StateService, usual: str) -> StateService:
    if bool(made.type) != bool(made.field):
        missing = "field" if made.type else "type"
        hint = f"write `{key}: {{name: ..., type: ..., field: ...}}`"
        what = "is missing: type and field belong together"
        raise section.section(key).error(missing, what, hint)
    return made if made.type else replace(made, type=usual, field=state.FIELD)


def _topic(section: Section, made: TopicSpec) -> TopicSpec:
    if made.origin is Origin.ROBOT and section.has("select"):
        what = "has no effect here: what the robot publishes comes from one place"
        raise section.error("select", what, "remove it")
    return made


def _metrics(section: Section, made: MetricsSpec) -> MetricsSpec:
    seen: set[str] = set()
    for key, endpoint in vars(made).items():
        if endpoint and endpoint in seen:
            raise section.error(key, f"`{endpoint}` is used twice", "give each its own port")
        seen.add(endpoint)
    if made.replica and int(made.replica.rpartition(":")[2]) > _LAST_REPLICA_PORT:
        what = "is too high: replica SLOT uses this port plus SLOT, which would be above 65535"
        raise section.error("replica", what, f"write a port up to {_LAST_REPLICA_PORT}")
    return made


def _schedule_zone(section: Section, made: ScheduleSpec) -> ScheduleSpec:
    try:
        schedule.zone(made.time_zone)
    except ValueError:
        raise section.error(
            "time_zone",
            f"there is no time zone {shown(made.time_zone)} on this machine",
            "write a name of the IANA database, such as `America/Los_Angeles`, or `UTC`; the "
            "Debian package `tzdata` contains the database",
        ) from None
    return made


def _window(section: Section, made: WindowSpec) -> WindowSpec:
    if made.replicas is None and made.max_usd_per_hour is None:
        raise section.error("replicas", "is missing, and so is `max_usd_per_hour`", "write one")
    if made.begins_s == DAY_END_S:
        raise section.error("from", "must be before 24:00", "write `from: 0:00`")
    if made.begins_s == made.ends_s:
        raise section.error("to", "must not be the same as `from`", "leave both out for all day")
    return replace(made, ends_s=made.ends_s or DAY_END_S)


def on_demand(section: Section, made: OnDemandSpec, replicas: int) -> None:
    """Check `on_demand` against the number of replicas."""
    if made.base > replicas:
        what = f"is {made.base}, but there are only {replicas} replicas"
        raise section.error("base", what, "write fewer, or ask for more replicas")
    if made.standbys and not made.fallback:
        what = "has no effect without `fallback`"
        raise section.error("standbys", what, "write `fallback: true`, or remove it")


def _topology(section: Section, made: Topology) -> Topology:
    if not made.gateways:
        hint = "write a list, such as `gateways: [{name: edge, endpoint: edge.example.org:7470}]`"
        raise section.error("gateways", "is missing", hint)
    known = [gateway.name for gateway in made.gateways]
    below = section.sections("gateways", "")
    slots: dict[int, str] = {}
    for one, gateway in zip(below, made.gateways, strict=True):
        other = slots.setdefault(gateway_slot(gateway.name), gateway.name)
        if other != gateway.name:
            what = f"`{gateway.name}` clashes with `{other}`: both names give the same number"
            raise one.error("name", what, "use another name")
        _check_known(one, "upstream", gateway.through, known)
    loop = find_loop({gateway.name: gateway.through for gateway in made.gateways})
    if loop:
        what = f"the gateways form a loop: {' -> '.join(loop)}"
        raise section.error("gateways", what, f"remove `{loop[1]}` from `upstream` of `{loop[0]}`")
    robots = section.sections("robots", "") if made.routes else ()
    for one, route in zip(robots, made.routes, strict=True):
        _check_known(one, "gateways", route.gateways, known)
    _check_known(section, "default_gateways", made.through, known)
    return made


def _check_known(section: Section, key: str, names: Sequence[str], known: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            hint = "known here: " + ", ".join(f"`{one}`" for one in known)
            raise section.error(key, f"there is no gateway {shown(name)}", hint)


RULES: dict[type, Callable[[Section, Any], Any]] = {
    ServiceSpec: _service,
    StateSpec: _state_services,
    TopicSpec: _topic,
    MetricsSpec: _metrics,
    ScheduleSpec: _schedule_zone,
    WindowSpec: _window,
    Topology: _topology,
}
