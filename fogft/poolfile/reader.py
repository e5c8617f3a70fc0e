"""Judge a pool file and turn it into a `PoolSpec`. Pure: the tree and the type check come in.

A pool file is a SkyPilot task with a `fogft` section. Ours is checked to the last key; of
SkyPilot's keys only the names are, and what a pool cannot do. The rest passes untouched.

Owns: what may stand in our keys, and what to tell the user.
Not here: YAML (`fogft.poolfile.yaml_tree`), loading types (`fogft.ros.types`), prices and regions
(the cloud judges `resources`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import PurePath

from fogft.model.middleware import Speaks
from fogft.model.names import POOL_NAME_PATTERN
from fogft.model.spec import MAX_REPLICAS, HealthSpec, PoolSpec, ServiceSpec
from fogft.model.topic import TopicSpec
from fogft.model.topology import Topology
from fogft.poolfile.connectivity import (
    read_dial_in,
    read_metrics,
    read_rendezvous,
    read_rmw,
    read_uplinks,
)
from fogft.poolfile.keys import DAY_S, FOGFT_KEYS, HEALTH_KEYS, LATER_KEYS, places
from fogft.poolfile.placement import (
    read_availability,
    read_groups,
    read_migration,
    read_on_demand,
    read_placement,
    read_schedule,
)
from fogft.poolfile.services import read_services
from fogft.poolfile.state import StateSpec
from fogft.poolfile.task import check_task
from fogft.poolfile.topics import read_actions, read_topics
from fogft.poolfile.topology import read_topology
from fogft.poolfile.tree import Node, Section, plain, shown

# What only this machine can tell. Each returns what is wrong, None if nothing is; what to
# do about it may follow after "; ".
TypeCheck = Callable[[str], str | None]  # of a service or message type
FieldCheck = Callable[[str, str], str | None]  # of a service type and a boolean response field
StateCheck = Callable[[StateSpec], str | None]  # of a service's `state`
ToleranceCheck = Callable[[str, Mapping[str, float]], str | None]  # of a type, by field
FolderCheck = Callable[[str], str | None]  # of `workdir`

MAX_SURGE = 4
MAX_HOURS = 8000  # the certificates last 365 days


def pool_spec(
    root: Node,
    file: str,
    *,
    check_types: TypeCheck | None = None,
    check_fields: FieldCheck | None = None,
    check_states: StateCheck | None = None,
    check_tolerances: ToleranceCheck | None = None,
    check_workdir: FolderCheck | None = None,
) -> PoolSpec:
    """Return what a pool file asks for.

    Args:
        root: The file's tree.
        file: Its name as the user wrote it: begins every message, and its stem is the
            pool's name where the file gives none.
        check_types: Says why a type of a service or message cannot be loaded here. Asked last,
            once for each, when all else is right.
        check_fields: Says why a type's response has no boolean field of that name.
        check_states: Says why a service's state cannot travel by the services that `state` names.
        check_tolerances: Says why a type's responses cannot be compared with such tolerances.
        check_workdir: Says why a `workdir` cannot be used here.

    Raises:
        SpecError: The first mistake found; ``file:line: key: what is wrong``.
    """
    top = Section(file, "", root, "write a SkyPilot task with a `fogft` section")
    check_task(top)
    ours = top.section("fogft", "write `fogft:` with `services:` below it")
    ours.only(FOGFT_KEYS, later=LATER_KEYS, elsewhere=places(FOGFT_KEYS))
    services = read_services(ours)
    action_services, action_topics = read_actions(ours)
    topics = (*read_topics(ours), *action_topics)
    cap = hours = None
    if "max_usd_per_hour" in ours.children:
        cap = ours.number("max_usd_per_hour", 1_000_000, "US dollars per hour")
    if "max_hours" in ours.children:
        hours = ours.number("max_hours", MAX_HOURS, "hours")
    task = {key: plain(node) for key, node in top.children.items() if key != "fogft"}
    availability, groups = read_availability(ours), read_groups(ours, task)
    # A target finds its own number; the file's is then the fewest.
    usual = sum(g.replicas for g in groups) or (1 if availability else PoolSpec.replicas)
    replicas = ours.whole("replicas", usual, 1, MAX_REPLICAS)
    spec = PoolSpec(
        name=_name(top),
        services=(*services, *action_services),
        replicas=replicas,
        max_surge=ours.whole("max_surge", PoolSpec.max_surge, 0, MAX_SURGE),
        max_usd_per_hour=cap,
        max_hours=hours,
        health=_health(ours),
        availability=availability,
        placement=read_placement(ours),
        on_demand=read_on_demand(
            ours.section("on_demand"), MAX_REPLICAS if availability else replicas
        ),
        groups=groups,
        schedule=read_schedule(ours),
        migration=read_migration(ours),
        rendezvous=read_rendezvous(ours),
        dial_in=read_dial_in(ours),
        topology=_topology(ours, services, topics),
        uplinks=read_uplinks(ours),
        metrics=read_metrics(ours),
        topics=topics,
        rmw=read_rmw(ours),
        task=task,
    )
    workdir = spec.task.get("workdir")
    if isinstance(workdir, str) and check_workdir is not None:
        _judge(top, "workdir", check_workdir(workdir))
    sections = ours.sections("services", "") if services else ()
    for section, service in zip(sections, services, strict=True):
        _check_quorum(section, service, spec)
    for section, service in zip(sections, services, strict=True):
        passes_through = spec.rmw.robot is Speaks.ZENOH and not service.needs_type
        if check_types is not None and not passes_through:
            _judge(section, "type", check_types(service.type))
        if service.ok_field and check_fields is not None:
            _judge(section, "ok_field", check_fields(service.type, service.ok_field))
        if service.tolerance and check_tolerances is not None:
            reason = check_tolerances(service.type, dict(service.tolerance))
            _judge(section, "tolerance", reason)
        if service.state is not None and check_states is not None:
            _judge(section, "state", check_states(service.state))
    _judge_topics(ours, check_types)
    _check_passes(ours, spec)
    return spec


def _check_passes(ours: Section, spec: PoolSpec) -> None:
    """Refuse what does not pass over Zenoh yet."""
    if spec.topics and Speaks.ZENOH in (spec.rmw.robot, spec.rmw.replica):
        key = "actions" if "actions" in ours.children else "topics"
        what = "does not go with `rmw: zenoh`: services only pass there"
        raise ours.error(key, what, "remove one of the two")


def _topology(
    ours: Section, services: tuple[ServiceSpec, ...], topics: tuple[TopicSpec, ...]
) -> Topology:
    found = read_topology(ours, services)
    if found and topics:
        key = "actions" if "actions" in ours.children else "topics"
        what = "does not go with `topology`: gateways pass services only"
        raise ours.error(key, what, "remove one of the two")
    return found


def _judge_topics(ours: Section, check_types: TypeCheck | None) -> None:
    for key, end in (("topics", ""), ("actions", "_SendGoal")):
        if key in ours.children and check_types is not None:
            for section in ours.sections(key, ""):
                _judge(section, "type", check_types(section.text("type", "") + end))


def _check_quorum(section: Section, service: ServiceSpec, spec: PoolSpec) -> None:
    """Refuse a quorum that can never be reached, or at some time of the week cannot."""
    windows = spec.schedule.windows if spec.schedule else ()
    fewest = min([spec.replicas, *(w.replicas for w in windows if w.replicas is not None)])
    carry = max(fewest, service.replicas)
    if service.quorum > carry:
        where = " in a window of `schedule`" if fewest < spec.replicas else ""
        raise section.error(
            "quorum",
            f"is {service.quorum}, but only {carry} can be asked{where}: no answer could win",
            f"write `replicas: {service.quorum}` or more there, or a smaller `quorum`",
        )


def _judge(section: Section, key: str, reason: str | None) -> None:
    if reason is not None:
        what, _, todo = reason.partition("; ")
        raise section.error(key, shown(what, 300)[1:-1], shown(todo, 300)[1:-1])


def _name(top: Section) -> str:
    hint = "use lower-case letters, digits and dashes, at most 40, such as `{}`"
    if "name" in top.children:
        name = top.text("name", hint.format("perception"))
        if POOL_NAME_PATTERN.fullmatch(name):
            return name
        raise top.error("name", f"{shown(name)} is not a pool name", hint.format(_slug(name)))
    name = PurePath(top.file).stem
    if POOL_NAME_PATTERN.fullmatch(name):
        return name
    what = f"is missing, and the file's own name {shown(name)} is not a pool name"
    raise top.error("name", what, f"add `name: {_slug(name)}`")


def _slug(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", name.lower())[:40].strip("-") or "perception"


def _health(ours: Section) -> HealthSpec:
    health = ours.section("health")
    health.only(HEALTH_KEYS, elsewhere=places(HEALTH_KEYS))
    return HealthSpec(
        suspect_after_s=health.number(
            "suspect_after_s", 3600, "seconds", HealthSpec.suspect_after_s
        ),
        replace_after_s=health.number(
            "replace_after_s", DAY_S, "seconds", HealthSpec.replace_after_s
        ),
        start_limit_s=health.number("start_limit_s", DAY_S, "seconds", HealthSpec.start_limit_s),
        orphan_after_s=ours.number(
            "orphan_after_s", 30 * DAY_S, "seconds", HealthSpec.orphan_after_s
        ),
    )
