"""What `up` is about to do with a pool file, before anything is changed.

Owns: the placements that a new pool would get, and what a changed file changes.
Not here: doing it (`startup`) and saying it (`fogft.cli`).
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fogft.cloud.port import Cloud
from fogft.core.errors import CloudError, PoolNotFound, SpecError
from fogft.core.history import History
from fogft.core.intent import Intent
from fogft.core.model import Observed, Offer
from fogft.core.planner import plan
from fogft.core.spec import PoolSpec
from fogft.core.spec_changes import changes, replaces_replicas
from fogft.pool import yaml_tree
from fogft.pool.store import PoolStore


@dataclass(frozen=True)
class PreviewedLaunch:
    """Where a replica would go now."""

    slot: int
    location: str
    instance: str
    usd_per_hour: float


@dataclass(frozen=True)
class Preview:
    """What applying a pool file would do.

    Attributes:
        launches: Of a new pool; by slot.
        changes: Of a pool that exists: what the file now says otherwise, in words.
        notes: What may surprise: fewer placements than replicas, no prices now.
    """

    spec: PoolSpec
    cloud: str
    is_new: bool
    launches: tuple[PreviewedLaunch, ...] = ()
    changes: tuple[str, ...] = ()
    replaces_replicas: bool = False
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Order:
    """A pool file that was read and judged, and what applying it would do."""

    preview: Preview
    source: str
    file: Path

    @property
    def spec(self) -> PoolSpec:
        """What the file asks for."""
        return self.preview.spec


def order(
    store: PoolStore, cloud: Cloud, spec: PoolSpec, *, cloud_name: str, source: str, file: Path
) -> Order:
    """Return what applying a pool file would do. Changes nothing.

    Raises:
        SpecError: The cloud can never meet the file's resources.
    """
    notes: tuple[str, ...] = ()
    offers: tuple[Offer, ...] = ()
    try:
        offers = tuple(cloud.offers(spec.task.get("resources") or {}))
    except SpecError as error:
        raise located(error, source, file) from None
    except CloudError as error:
        notes = (f"prices cannot be had now: {error.message}",)
    try:
        store.identity()
        before = store.spec()
    except (PoolNotFound, SpecError):
        found = _of_new(spec, cloud_name, offers, notes)
    else:
        found = Preview(
            spec,
            cloud_name,
            is_new=False,
            changes=tuple(changes(before, spec)),
            replaces_replicas=replaces_replicas(before, spec),
            notes=notes,
        )
    return Order(found, source, file)


def located(error: SpecError, source: str, file: Path) -> SpecError:
    """Return a cloud's complaint about a key with the file and the line that it is about."""
    key, colon, _ = error.message.partition(": ")
    node = yaml_tree.tree(source, str(file))
    for part in re.findall(r"[^.\[\]]+", key) if colon else ():
        value = node.value
        if isinstance(value, tuple) and part.isdigit() and int(part) < len(value):
            node = value[int(part)]
        elif isinstance(value, Mapping) and part in value:
            node = value[part]
        else:
            break
    return SpecError(f"{file}:{node.key_line}: {error.message}", error.hint)


def cloud_of(spec: PoolSpec, supported: Collection[str], source: str, file: Path) -> str | None:
    """Return the cloud that a pool file's resources name; None where they name none.

    Raises:
        SpecError: They name one that is not supported, or more than one.
    """
    named = dict(_named(spec.task.get("resources") or {}, "resources"))
    hint = (
        f"supported: {', '.join(f'`{cloud}`' for cloud in supported)}; "
        "or try the pool on this machine with `--cloud local`"
    )
    for cloud, key in named.items():
        if cloud not in supported:
            problem = SpecError(f"{key}: cloud `{cloud}` is not supported yet", hint)
            raise located(problem, source, file)
    if len(named) > 1:
        listed = " and ".join(f"`{cloud}`" for cloud in sorted(named))
        problem = SpecError(f"resources: name {listed}; one cloud a pool is supported", hint)
        raise located(problem, source, file)
    return next(iter(named), None)


def _named(resources: Any, key: str) -> Iterator[tuple[str, str]]:
    """Yield each cloud that is named, with the key that names it."""
    if not isinstance(resources, Mapping):
        return
    for name in ("infra", "cloud"):
        if isinstance(resources.get(name), str):
            cloud = resources[name].split("/")[0].strip().lower()
            if cloud not in ("", "*"):
                yield cloud, f"{key}.{name}"
    for name in ("any_of", "ordered"):
        choices = resources.get(name)
        for index, choice in enumerate(choices if isinstance(choices, list) else ()):
            yield from _named(choice, f"{key}.{name}[{index}]")


def _of_new(
    spec: PoolSpec, cloud_name: str, offers: tuple[Offer, ...], notes: tuple[str, ...]
) -> Preview:
    planned = plan("0" * 16, spec, Intent(), Observed(0.0, (), None, offers), History())
    launches = tuple(
        PreviewedLaunch(
            launch.slot,
            launch.offer.placement.location,
            launch.offer.placement.instance,
            launch.offer.usd_per_hour,
        )
        for launch in planned.launches
    )
    return Preview(spec, cloud_name, is_new=True, launches=launches, notes=notes or planned.notes)
