"""Build a replica's SkyPilot task: the pool file's task merged with `templates/sky_task.yaml`.

Other fields pass through unchanged; fields that the pool controls are rejected, not ignored.
"""

import copy
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fogft import template_files
from fogft.cloud.port import Launch
from fogft.cloud.sky import naming
from fogft.errors import CloudError, FogftError, SpecError
from fogft.model.names import LINK_PORT, NO_VM_CLOUDS, SETUP_LIMIT_S
from fogft.model.replica import Placement
from fogft.poolfile.named_clouds import alternatives, place, sells

OURS = "~/.fogft"
DISK_GB = 64  # default if the pool file sets none; SkyPilot's default is 256
_CHOICES = (
    *("infra", "cloud", "region", "zone", "any_of", "ordered"),
    *("instance_type", "use_spot", "accelerators", "cpus", "memory"),
)
FEATURES = ("use_spot", "ports", "autostop")  # a cloud may lack these for all its machines
_REFUSED_RESOURCES = {
    "ports": "only the link's port is opened; robots reach the services through it",
    "autostop": "a replica runs as long as its pool needs it",
    "job_recovery": "fogft replaces lost machines",
}


def refuse_what_cannot_be_honoured(task: Mapping[str, Any]) -> None:
    """Raise `SpecError` if a checked pool file's task sets a field that the pool controls."""
    for target in task.get("file_mounts") or {}:
        if f"{os.path.normpath(str(target))}/".startswith(f"{OURS}/"):
            raise SpecError.of_key(f"file_mounts.{target}", f"`{OURS}` is fogft's own folder")
    for where, entry in alternatives(task.get("resources") or {}):
        for key, reason in _REFUSED_RESOURCES.items():
            if entry.get(key, []) != []:
                raise SpecError.of_key(f"{where}.{key}", "is not supported in a pool", reason)
        for label in entry.get("labels") or {}:
            if str(label).startswith(naming.PREFIX):
                raise SpecError.of_key(f"{where}.labels.{label}", "this prefix is fogft's own")
        cloud = place(entry)[0]
        if cloud in NO_VM_CLOUDS:
            raise SpecError.of_key(
                where,
                f"`{cloud}` offers no VMs",
                "name clouds that sell VMs, such as `infra: aws/us-west-2`",
            )


def check(task: Mapping[str, Any]) -> None:
    """Raise `SpecError` too if two alternatives cannot be told apart at a launch."""
    refuse_what_cannot_be_honoured(task)
    of_machine: dict[tuple[object, ...], Mapping[str, Any]] = {}
    for where, entry in alternatives(task.get("resources") or {}):
        machine = *place(entry), entry.get("instance_type"), bool(entry.get("use_spot"))
        kept = {key: value for key, value in entry.items() if key not in _CHOICES}
        if of_machine.setdefault(machine, kept) != kept:
            raise SpecError.of_key(
                where,
                "differs from an earlier alternative in the same place by more than the machine",
                "name the `instance_type` of each, or put them into `fogft.groups`",
            )


def as_launched(resources: Mapping[str, Any]) -> dict[str, Any]:
    """Return `resources` plus what a launch adds to it, which a cloud may not support."""
    ours = dict(read()["resources"])
    ours["ports"] = list(resources.get("ports", [LINK_PORT]))
    if not ours["ports"]:
        del ours["ports"]
    kept = {key: value for key, value in resources.items() if key != "ports"}
    return {**kept, "disk_size": kept.get("disk_size") or DISK_GB, **ours}


def alternative(resources: Mapping[str, Any], placement: Placement) -> Mapping[str, Any]:
    """Return the alternative that a placement was offered for; a stand-in's market is another.

    Of several, the one that names the machine, or the place, more precisely.
    """
    machine = placement.instance.partition("+")[0]
    fitting = (
        entry
        for _, entry in alternatives(resources)
        if sells(entry, placement.cloud, placement.region, placement.zone)
        and entry.get("instance_type") in (None, machine)
    )

    def distance(entry: Mapping[str, Any]) -> tuple[bool, bool, int]:
        other_market = bool(entry.get("use_spot")) != placement.spot
        return other_market, not entry.get("instance_type"), place(entry).count("")

    return min(fitting, key=distance, default=resources)


def build(
    order: Launch,
    *,
    files: Path,
    wheel: Path,
    owner: str,
    instead: Sequence[Placement] = (),
) -> dict[str, Any]:
    """Return the task of one replica, for exactly one location.

    `instead`: placements to try, in order, if there is no capacity.
    """
    refuse_what_cannot_be_honoured(order.task)
    template = read()
    marks = {
        "@FILES@": str(files),
        "@WHEEL@": str(wheel),
        "@PORT@": str(order.link_port),
        "@LISTEN@": f"{'127.0.0.1' if order.dials_out else '0.0.0.0'}:{order.link_port}",
    }
    ours = _filled(template, marks)
    if order.dials_out:
        del ours["resources"]["ports"]
    else:
        ours["resources"]["ports"] += map(str, order.more_ports)
    task = copy.deepcopy({k: v for k, v in order.task.items() if k != "num_nodes"})
    task["name"] = order.pool
    task["setup"], task["run"] = setup_of(order.task, template), ours["run"]
    task["file_mounts"] = {**(task.get("file_mounts") or {}), **ours["file_mounts"]}
    resources = _resources(order, owner) | ours["resources"]
    if instead:
        del resources["instance_type"]
        resources.pop("accelerators", None)
        resources["ordered"] = [_kind(one) for one in (order.placement, *instead)]
    task["resources"] = resources
    return task


def setup_of(asked: Mapping[str, Any], template: Mapping[str, Any]) -> str:
    """Return the set-up script for a task, which creates the environment and installs fogft."""
    setup = str(asked.get("setup") or ":").rstrip()
    # The user's text is filled in last, so that marks in it stay unchanged.
    marks = {"@SETUP_LIMIT_S@": str(SETUP_LIMIT_S), "@SETUP@": setup}
    return str(_filled(template["setup"], marks))


def _kind(placement: Placement) -> dict[str, str]:
    instance, _, accelerators = placement.instance.partition("+")
    kind = {"instance_type": instance}
    return {**kind, "accelerators": accelerators} if accelerators else kind


def _resources(order: Launch, owner: str) -> dict[str, Any]:
    chosen = alternative(order.task.get("resources") or {}, order.placement)
    out = {k: copy.deepcopy(v) for k, v in chosen.items() if k not in _CHOICES}
    out["disk_size"] = out.get("disk_size") or DISK_GB
    out["infra"] = naming.infra(order.placement)
    out["use_spot"] = order.placement.spot
    out |= _kind(order.placement)
    out["labels"] = dict(chosen.get("labels") or {}) | naming.labels(order, owner)
    return out


def _filled(value: Any, marks: Mapping[str, str]) -> Any:
    if isinstance(value, Mapping):
        return {key: _filled(inner, marks) for key, inner in value.items()}
    if isinstance(value, list):
        return [_filled(inner, marks) for inner in value]
    if not isinstance(value, str):
        return value
    for mark, meant in marks.items():
        value = value.replace(mark, meant)
    return value


def read() -> dict[str, Any]:
    """Return the template. Raises CloudError: the installation is incomplete or damaged."""
    import yaml

    try:
        return dict(yaml.safe_load(template_files.read_text("sky_task.yaml")))
    except (FogftError, yaml.YAMLError, TypeError, ValueError) as error:
        what = f"fogft's own `sky_task.yaml` cannot be read: {error}"
        raise CloudError(what, "reinstall fogft") from error
