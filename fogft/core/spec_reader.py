"""Judge a pool file and turn it into a `PoolSpec`. Pure: the tree and the type check come in.

A pool file is a SkyPilot task with a `fogft` section. Ours is checked to the last key; of
SkyPilot's keys only the names are, and what a pool cannot do. The rest passes untouched.

Owns: which keys there are, what may stand in them, and what to tell the user.
Not here: YAML (`fogft.pool.yaml_tree`), loading types (`check_types`), prices and regions
(the cloud judges `resources`).
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import PurePath

from fogft.core import ros_names
from fogft.core.names import POOL_NAME_PATTERN
from fogft.core.spec import HealthSpec, PoolSpec, ServiceSpec
from fogft.core.spec_tree import Node, Section, plain, shown

# What only this machine can tell. Each returns what is wrong, None if nothing is; what to
# do about it may follow after "; ".
TypeCheck = Callable[[str], str | None]  # of a service type
FieldCheck = Callable[[str, str], str | None]  # of a service type and a boolean response field
FolderCheck = Callable[[str], str | None]  # of `workdir`

MAX_REPLICAS = 16
MAX_SURGE = 4
DAY_S = 86_400.0

FOGFT_KEYS = (
    "services",
    "replicas",
    "max_surge",
    "max_usd_per_hour",
    "health",
    "orphan_after_s",
)
SERVICE_KEYS = ("name", "type", "timeout_s", "on_timeout", "ok_field")
HEALTH_KEYS = ("suspect_after_s", "replace_after_s", "start_limit_s")
# The task schema of SkyPilot 0.14.1, without the keys that it keeps for itself.
TASK_KEYS = (
    "name",
    "workdir",
    "event_callback",
    "num_nodes",
    "resources",
    "file_mounts",
    "setup",
    "run",
    "envs",
    "secrets",
    "managed_secrets",
    "inputs",
    "outputs",
    "config",
    "volumes",
    "api_server_access",
)
REFUSED_TASK_KEYS = {
    "service": "it is SkyServe's; list what to replicate under `fogft.services` instead",
    "pool": "it is for SkyPilot's own worker pools; the file is a pool by its `fogft` section",
}
# Designed, not built. Ignoring one would promise what nobody does.
LATER_KEYS = {
    "availability": "remove it and say how many: `replicas: 2`",
    "groups": "remove it; each pool file describes one pool of equal replicas",
    "topology": "remove it; every replica is linked to the robot directly",
    "on_demand": "remove it, or set `resources.use_spot: false` for on-demand machines only",
    "schedule": "remove it, and use `fogft scale` or `fogft down` from a timer",
    "max_hours": "remove it, and use `fogft down` from a timer",
    "hedging": "remove it; every request goes to all replicas at once",
    "state": "remove it; the services must be stateless",
    "quorum": "remove it; the first successful response is returned",
}
_SERVICES_HINT = "write a list, such as `services: [{name: /detect, type: my_msgs/srv/Detect}]`"
_ENV_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def pool_spec(
    root: Node,
    file: str,
    *,
    check_types: TypeCheck | None = None,
    check_fields: FieldCheck | None = None,
    check_workdir: FolderCheck | None = None,
) -> PoolSpec:
    """Return what a pool file asks for.

    Args:
        root: The file's tree.
        file: Its name as the user wrote it: begins every message, and its stem is the
            pool's name where the file gives none.
        check_types: Says why a service type cannot be loaded here. Asked last, once a
            service, when all else is right.
        check_fields: Says why a type's response has no boolean field of that name.
        check_workdir: Says why a `workdir` cannot be used here.

    Raises:
        SpecError: The first mistake found; ``file:line: key: what is wrong``.
    """
    top = Section(file, "", root, "write a SkyPilot task with a `fogft` section")
    _task(top)
    ours = top.section("fogft", "write `fogft:` with `services:` below it")
    ours.only(FOGFT_KEYS, later=LATER_KEYS, elsewhere=_places(FOGFT_KEYS))
    services = _services(ours)
    cap = None
    if "max_usd_per_hour" in ours.children:
        cap = ours.number("max_usd_per_hour", 1_000_000, "US dollars per hour")
    spec = PoolSpec(
        name=_name(top),
        services=services,
        replicas=ours.whole("replicas", PoolSpec.replicas, 1, MAX_REPLICAS),
        max_surge=ours.whole("max_surge", PoolSpec.max_surge, 0, MAX_SURGE),
        max_usd_per_hour=cap,
        health=_health(ours),
        task={key: plain(node) for key, node in top.children.items() if key != "fogft"},
    )
    workdir = spec.task.get("workdir")
    if isinstance(workdir, str) and check_workdir is not None:
        _judge(top, "workdir", check_workdir(workdir))
    for section, service in zip(ours.sections("services", ""), services, strict=True):
        if check_types is not None:
            _judge(section, "type", check_types(service.type))
        if service.ok_field and check_fields is not None:
            _judge(section, "ok_field", check_fields(service.type, service.ok_field))
    return spec


def _judge(section: Section, key: str, reason: str | None) -> None:
    if reason is not None:
        what, _, todo = reason.partition("; ")
        raise section.error(key, shown(what, 300)[1:-1], shown(todo, 300)[1:-1])


def _task(top: Section) -> None:
    for key, reason in REFUSED_TASK_KEYS.items():
        if key in top.children:
            raise top.error(key, "cannot stand in a pool file", reason, at_key=True)
    top.only((*TASK_KEYS, "fogft"), later=LATER_KEYS, elsewhere=_places(TASK_KEYS))
    if "fogft" not in top.children:
        raise top.error("fogft", "is missing", "add `fogft:` with `services:` below it")
    top.text("run", "write the command that starts your service, such as `run: exec python3 x.py`")
    if top.has("num_nodes"):
        nodes = top.children["num_nodes"].value
        if isinstance(nodes, bool) or nodes != 1:
            raise top.error(
                "num_nodes",
                f"must be 1, not {shown(plain(top.children['num_nodes']))}: "
                "a replica is one machine",
                "remove it, and set `fogft.replicas` for more replicas",
            )
    for key in ("resources", "file_mounts", "envs", "config", "volumes"):
        if top.has(key):
            top.section(key)
    if top.has("setup"):
        top.text("setup", "write the commands that install what `run` needs, or remove it")
    if top.has("envs"):
        _envs(top.section("envs"))


def _envs(envs: Section) -> None:
    for key, node in envs.children.items():
        if not _ENV_NAME.fullmatch(key):
            raise envs.error(
                key,
                "is not the name of an environment variable",
                "use letters, digits and `_`, and begin with no digit",
                at_key=True,
            )
        if node.value is None or isinstance(node.value, (tuple, dict)):
            raise envs.error(key, "must have a text for a value", f'write `{key}: "..."`')


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


def _services(ours: Section) -> tuple[ServiceSpec, ...]:
    found: dict[str, ServiceSpec] = {}
    lines: dict[str, int] = {}
    for section in ours.sections("services", _SERVICES_HINT):
        section.only(SERVICE_KEYS, later=LATER_KEYS, elsewhere=_places(SERVICE_KEYS))
        service = _service(section)
        if service.name in found:
            raise section.error(
                "name",
                f"`{service.name}` stands here twice (first in line {lines[service.name]})",
                "give each service one entry",
            )
        found[service.name] = service
        lines[service.name] = section.children["name"].line
    return tuple(found.values())


def _service(section: Section) -> ServiceSpec:
    written = section.text("name", "write the service's name, such as `name: /detect`")
    try:
        name = ros_names.absolute_service_name(written)
    except ValueError as error:
        what = f"{shown(written)} is not a service name: {error}"
        raise section.error("name", what, "write a name such as `/detect`") from None
    ok_field = section.text("ok_field", "name a boolean field of the response", default="")
    if ok_field and not ros_names.is_field_name(ok_field):
        what = f"{shown(ok_field)} is not the name of a field"
        raise section.error("ok_field", what, "name a boolean field, such as `success`")
    return ServiceSpec(
        name=name,
        type=_type(section),
        timeout_s=section.number("timeout_s", DAY_S, "seconds", ServiceSpec.timeout_s),
        on_timeout=section.choice("on_timeout", ServiceSpec.on_timeout),
        ok_field=ok_field,
    )


def _type(section: Section) -> str:
    example = "write `package/srv/Name`, such as `type: std_srvs/srv/SetBool`"
    written = section.text("type", example)
    if ros_names.is_service_type(written):
        return written
    meant = ros_names.suggested_service_type(written)
    raise section.error(
        "type",
        f"{shown(written)} is not a service type",
        f"did you mean `{meant}`?" if meant else example,
    )


def _health(ours: Section) -> HealthSpec:
    health = ours.section("health")
    health.only(HEALTH_KEYS, elsewhere=_places(HEALTH_KEYS))
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


def _places(here: tuple[str, ...]) -> dict[str, str]:
    """Say of every key that is not at home here where it is."""
    homes = (
        (HEALTH_KEYS, "under `fogft.health`"),
        (("timeout_s", "on_timeout", "ok_field"), "in a service, under `fogft.services`"),
        (FOGFT_KEYS, "under `fogft`"),
        (("run", "setup", "resources", "workdir", "envs"), "at the top level of the file"),
    )
    return {key: place for keys, place in homes for key in keys if key not in here}
