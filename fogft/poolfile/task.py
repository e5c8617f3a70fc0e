"""Check the SkyPilot part of a pool file: key names, and values that no pool supports."""

import re
from collections.abc import Mapping, Sequence

from fogft.model.spec import PoolSpec
from fogft.poolfile import removed
from fogft.poolfile.tree import Mistakes, Section, plain, shown

# The task schema of SkyPilot 0.14.1, without the keys that it keeps for itself.
TASK_KEYS = (
    *("name", "workdir", "event_callback", "num_nodes", "resources", "file_mounts", "setup", "run"),
    *("envs", "secrets", "managed_secrets", "inputs", "outputs", "config", "volumes"),
    "api_server_access",
)
RESOURCE_KEYS = (  # the same of its `resources`
    *("infra", "cloud", "region", "zone", "use_spot", "instance_type", "cpus", "memory"),
    *("accelerators", "accelerator_args", "autostop", "disk_size", "disk_tier"),
    *("ephemeral_storage", "image_id", "job_recovery", "labels", "local_disk", "max_hourly_cost"),
    *("network_tier", "ports", "priority", "priority_class", "volumes"),
)
REFUSED_TASK_KEYS = {
    "service": "it is SkyServe's; list what to replicate under `fogft.services` instead",
    "pool": "it is for SkyPilot's own worker pools; the file is a pool by its `fogft` section",
}

_ENV_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def check_task(top: Section, mistakes: Mistakes) -> None:
    """Check the top level of a pool file."""
    mistakes.add(
        top.error(key, "is not allowed in a pool file", reason, at_key=True)
        for key, reason in REFUSED_TASK_KEYS.items()
        if key in top.children
    )
    known, hints = (*TASK_KEYS, *REFUSED_TASK_KEYS, "fogft"), removed.HINTS[PoolSpec]
    mistakes.add(top.unknown(known, hints=hints, elsewhere=removed.places(None)))
    with mistakes.step():
        if "fogft" not in top.children:
            raise top.error("fogft", "is missing", "add `fogft:` with `services:` below it")
    with mistakes.step():
        start = "write the command that starts your service, such as `run: exec python3 x.py`"
        top.text("run", start)
    with mistakes.step():
        _one_machine(top)
    for key in ("resources", "file_mounts", "envs", "secrets", "config", "volumes"):
        with mistakes.step():
            if top.has(key):
                top.section(key)
    with mistakes.step():
        if top.has("setup"):
            top.text("setup", "write the commands that install what `run` needs, or remove it")
    for key, check in (("envs", _envs), ("secrets", _envs), ("resources", check_resources)):
        with mistakes.step():
            if top.has(key) and isinstance(top.children[key].value, Mapping):
                check(top.section(key))
    with mistakes.step():
        if top.has("workdir"):
            _workdir(top)


def _one_machine(top: Section) -> None:
    nodes = top.children["num_nodes"] if top.has("num_nodes") else None
    if nodes is not None and (isinstance(nodes.value, bool) or nodes.value != 1):
        raise top.error(
            "num_nodes",
            f"must be 1, not {shown(plain(nodes))}: a replica is one machine",
            "remove it, and set `fogft.replicas` for more replicas",
        )


def _workdir(top: Section) -> None:
    written = top.children["workdir"].value
    if isinstance(written, str) or (isinstance(written, Mapping) and "url" in written):
        return
    what = f"must be a folder or a repository, not {shown(plain(top.children['workdir']))}"
    raise top.error("workdir", what, "write `workdir: .`, or `workdir: {url: ..., ref: ...}`")


def check_resources(resources: Section, lists: Sequence[str] = ("any_of", "ordered")) -> None:
    """Check the key names, and values that fogft reads: SkyPilot takes any value as a boolean."""
    resources.only((*RESOURCE_KEYS, *lists, *(k for k in resources.children if k[:1] == "_")))
    for key in lists:
        if resources.has(key):
            for one in resources.sections(key, "write a list of maps"):
                check_resources(one, lists=())
    if resources.has("any_of") and resources.has("ordered") and lists:
        raise resources.error("ordered", "cannot be combined with `any_of`", "keep one of them")
    if resources.has("labels"):
        resources.section("labels", "write a map")
    if resources.has("use_spot"):
        resources.flag("use_spot", False)


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
            raise envs.error(key, "must have a text as its value", f'write `{key}: "..."`')
