"""Check a pool file and turn it into a `PoolSpec`. Pure: tree and type checks are passed in."""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import PurePath
from typing import Any, NamedTuple

from fogft.errors import FogftError
from fogft.model.choices import MAX_REPLICAS, GroupSpec, Speaks
from fogft.model.groups import MAX_GROUPS, overridden
from fogft.model.names import NAMES_BYTES_LIMIT, POOL_NAME_PATTERN
from fogft.model.spec import CONCURRENCY_LIMIT, Part, PoolSpec, ServiceSpec
from fogft.model.state import StateSpec
from fogft.model.topic import DEPTH_LIMIT, ActionSpec, Origin, Select, TopicSpec
from fogft.poolfile import rules
from fogft.poolfile.reader import Reader
from fogft.poolfile.task import check_resources, check_task
from fogft.poolfile.tree import Mistakes, Node, Section, plain, shown


def _nothing(*_: object) -> None:
    return None


class Checks(NamedTuple):
    """Checks that depend on this machine, run when everything else is valid.

    Each returns the problem with a hint, or None if there is none.
    """

    types: Callable[[str], FogftError | None] = _nothing  # why a type cannot be loaded
    # Why a type's response has no such boolean.
    fields: Callable[[str, str], FogftError | None] = _nothing
    states: Callable[[StateSpec], FogftError | None] = _nothing
    # Why tolerances do not fit the fields of a type.
    tolerances: Callable[[str, Mapping[str, float]], FogftError | None] = _nothing
    workdir: Callable[[str], FogftError | None] = _nothing


UNCHECKED = Checks()


def pool_spec(
    root: Node, file: str, checks: Checks = UNCHECKED, mistakes: Mistakes | None = None
) -> PoolSpec:
    """Return the spec in a pool file; without `mistakes`, the first mistake is raised."""
    mistakes = mistakes or Mistakes()
    top = Section(file, "", root, "write a SkyPilot task with a `fogft` section")
    task = {key: plain(node) for key, node in top.children.items() if key != "fogft"}

    def whole(section: Section, made: PoolSpec) -> PoolSpec:
        return _whole(section, replace(made, task=task))

    with mistakes.whole():
        check_task(top, mistakes)
        ours = top.section("fogft", "write `fogft:` with `services:` below it")
        reader = Reader({**rules.RULES, PoolSpec: whole}, mistakes)
        with mistakes.step():
            spec: PoolSpec = reader.map(PoolSpec, ours)
        with mistakes.step():
            name = _name(top)
    shared: Any = task.get("resources") or {}  # known to be a map only here
    groups = tuple(replace(g, resources=overridden(shared, g.resources)) for g in spec.groups)
    spec = replace(spec, name=name, groups=groups)
    _judge_here(top, ours, spec, checks, mistakes)
    return spec


def _judge_here(
    top: Section, ours: Section, spec: PoolSpec, checks: Checks, mistakes: Mistakes
) -> None:
    workdir = spec.task.get("workdir")
    if isinstance(workdir, str):
        with mistakes.step():
            _judge(top, "workdir", checks.workdir(workdir))
    sections = ours.sections("services", "") if "services" in ours.children else ()
    for section, service in zip(sections, spec.services, strict=False):
        with mistakes.step():
            _check_quorum(section, service, spec)
        with mistakes.step():
            _judge_types(section, service, spec, checks)
    for key, end in (("topics", ""), ("actions", "_SendGoal")):
        for section in ours.sections(key, "") if key in ours.children else ():
            with mistakes.step():
                _judge(section, "type", checks.types(section.text("type", "") + end))


def _judge_types(section: Section, service: ServiceSpec, spec: PoolSpec, checks: Checks) -> None:
    if spec.rmw.robot is not Speaks.ZENOH or service.needs_type:
        _judge(section, "type", checks.types(service.type))
    if service.ok_field:
        _judge(section, "ok_field", checks.fields(service.type, service.ok_field))
    if service.tolerance:
        _judge(section, "tolerance", checks.tolerances(service.type, service.tolerance))
    if service.state is not None:
        _judge(section, "state", checks.states(service.state))


def _whole(ours: Section, made: PoolSpec) -> PoolSpec:
    groups = _groups(ours, made)
    # An `availability` target sets the number; the file's is then the minimum.
    if "replicas" not in ours.children:
        usual = sum(g.replicas for g in groups) or (1 if made.availability else made.replicas)
        made = replace(made, replicas=usual)
    if ours.has("on_demand"):
        most = MAX_REPLICAS if made.availability else made.replicas
        rules.on_demand(ours.section("on_demand"), made.on_demand, most)
    spec = replace(
        made,
        groups=groups,
        services=(*made.services, *(one for a in made.actions for one in action_services(a))),
        topics=(*made.topics, *(one for a in made.actions for one in action_topics(a))),
    )
    _check_topology(ours, made.services, spec)
    names = [*(one.name for one in spec.services), *(one.name for one in spec.topics)]
    size = sum(map(len, names))
    if size > NAMES_BYTES_LIMIT:
        what = f"and topics have names of {size} bytes in total; the limit is {NAMES_BYTES_LIMIT}"
        raise ours.error("services", what, "use shorter names, or two pools", at_key=True)
    if spec.topics and Speaks.ZENOH in (spec.rmw.robot, spec.rmw.replica):
        what = "cannot be combined with `rmw: zenoh`, which supports only services"
        raise ours.error(_topics_key(ours), what, "remove one of the two")
    return spec


def _groups(ours: Section, made: PoolSpec) -> tuple[GroupSpec, ...]:
    if not made.groups:
        return ()
    for key in ("replicas", "on_demand"):
        if key in ours.children:
            instead = f"each group has its own `{key}`"
            raise ours.error(key, "cannot be combined with `groups`", instead, at_key=True)
    for section, group in zip(ours.sections("groups", ""), made.groups, strict=True):
        rules.on_demand(section.section("on_demand"), group.on_demand, group.replicas)
        check_resources(section.section("resources"))
    if len(made.groups) > MAX_GROUPS:
        raise ours.error("groups", f"has {len(made.groups)} entries; the maximum is {MAX_GROUPS}")
    total = sum(group.replicas for group in made.groups)
    if total > MAX_REPLICAS:
        raise ours.error("groups", f"ask for {total} replicas; the maximum is {MAX_REPLICAS}")
    return made.groups


def _check_topology(ours: Section, services: tuple[ServiceSpec, ...], spec: PoolSpec) -> None:
    launched = spec.gateway.launch
    check_resources(ours.section("gateway").section("resources"))
    if not spec.topology and not launched:
        return
    where = "gateway" if launched else "topology"
    for service in services:
        key = "state" if service.state is not None else "quorum" if service.quorum > 1 else ""
        if key:
            raise ours.error(
                where,
                f"cannot be combined with service `{service.name}`, which has `{key}`",
                "put that service into its own pool: the robot must ask each replica itself",
            )
    for key in ("topology", "rendezvous", "dial_in") if launched else ():
        if ours.has(key):
            what = "cannot be combined with `gateway: {launch: true}`, which sets it"
            raise ours.error(key, what, "remove one of the two")
    if launched and not services:
        what = "needs `services`: it cannot find out what replicas offer"
        raise ours.error(where, what, "list the services")
    if not launched and not spec.rendezvous:
        raise ours.error(
            "topology",
            "needs a `rendezvous`, through which gateways find replicas",
            "add one, such as `rendezvous: [meet.example.org:7450]`",
        )
    if spec.topics:
        what = f"cannot be combined with `{where}`: gateways support only services"
        raise ours.error(_topics_key(ours), what, "remove one of the two")


def _topics_key(ours: Section) -> str:
    return "actions" if "actions" in ours.children else "topics"


def _check_quorum(section: Section, service: ServiceSpec, spec: PoolSpec) -> None:
    windows = spec.schedule.windows if spec.schedule else ()
    fewest = min([spec.replicas, *(w.replicas for w in windows if w.replicas)])
    if service.quorum > fewest:
        where = " in a window of `schedule`" if fewest < spec.replicas else ""
        raise section.error(
            "quorum",
            f"is {service.quorum}, but only {fewest} can be asked{where}: no answer could win",
            f"write `replicas: {service.quorum}` or more there, or a smaller `quorum`",
        )


def _judge(section: Section, key: str, found: FogftError | None) -> None:
    if found is not None:
        raise section.error(key, shown(found.message, 300)[1:-1], shown(found.hint, 300)[1:-1])


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


def action_services(action: ActionSpec) -> tuple[ServiceSpec, ...]:
    """Return the three services of an action."""
    name, type, soon_s = f"{action.name}/_action", action.type, action.timeout_s
    return (
        ServiceSpec(f"{name}/send_goal", f"{type}_SendGoal", soon_s, part=Part.GOAL),
        ServiceSpec(f"{name}/cancel_goal", "action_msgs/srv/CancelGoal", soon_s, part=Part.CANCEL),
        ServiceSpec(
            f"{name}/get_result",
            f"{type}_GetResult",
            action.result_timeout_s,
            # It is answered when its goal ends: many requests wait there without using capacity.
            concurrency=CONCURRENCY_LIMIT,
            part=Part.RESULT,
        ),
    )


def action_topics(action: ActionSpec) -> tuple[TopicSpec, ...]:
    """Return the two topics of an action."""
    feedback, status = f"{action.name}/_action/feedback", f"{action.name}/_action/status"
    of_feedback, of_status = f"{action.type}_FeedbackMessage", "action_msgs/msg/GoalStatusArray"
    # Deep enough for the feedback of all goals between two pulls.
    return (
        TopicSpec(feedback, of_feedback, Origin.REPLICAS, Select.GOAL, depth=DEPTH_LIMIT),
        TopicSpec(status, of_status, Origin.REPLICAS, Select.STATUS, depth=1, latched=True),
    )
