"""Names and labels of a replica's machine in a cloud. Pure.

A machine whose name or labels do not match is not ours and is never touched: `cluster_name` makes
every cluster name that is passed to SkyPilot.
"""

import re
from collections.abc import Mapping

from fogft.cloud.port import Launch
from fogft.model.names import LINK_PORT, POOL_UID_PATTERN
from fogft.model.replica import Placement, ReplicaId

PREFIX = "fogft-"
POOL = "fogft-pool"
SLOT = "fogft-slot"
GENERATION = "fogft-generation"
OWNER = "fogft-owner"
SPEC = "fogft-spec"
PRICE = "fogft-microusd"
PORT = "fogft-port"
NAME = "fogft-name"
MAPPING_CLOUDS = frozenset({"runpod", "vast", "yotta"})
"""Clouds whose machines are reached at a mapped address and port."""

_NAME = re.compile(r"fogft-([0-9a-f]{16})-(\d{1,9})-(\d{1,9})")
_NUMBER = re.compile(r"\d{1,9}")
_NOT_A_LABEL = re.compile(r"[^a-z0-9_-]")


def cluster_name(id: ReplicaId) -> str:
    """Return the name of a replica's cluster: ``fogft-<uid>-<slot>-<generation>``."""
    name = f"{PREFIX}{id.pool_uid}-{id.slot}-{id.generation}"
    if replica_of(name) != id:  # the name would not parse back to this id
        raise ValueError(f"not a replica's id: {id!r}")
    return name


def replica_of(name: str) -> ReplicaId | None:
    """Return the replica whose cluster has this name, or None if it is not one of ours."""
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    id = ReplicaId(match[1], int(match[2]), int(match[3]))
    return id if name == f"{PREFIX}{id.pool_uid}-{id.slot}-{id.generation}" else None


def labels(order: Launch, owner: str) -> dict[str, str]:
    """Return the labels for a machine to launch, in characters that every cloud accepts."""
    return {
        POOL: order.id.pool_uid,
        SLOT: str(order.id.slot),
        GENERATION: str(order.id.generation),
        OWNER: label_value(owner),
        SPEC: label_value(order.spec_hash),
        PRICE: str(round(order.usd_per_hour * 1e6)),
        PORT: str(order.link_port),
        NAME: label_value(order.pool),
    }


def replica_of_labels(found: Mapping[str, str]) -> ReplicaId | None:
    """Return the replica whose machine has these labels, or None if it is not one of ours."""
    uid, slot, generation = (found.get(key, "") for key in (POOL, SLOT, GENERATION))
    if not (POOL_UID_PATTERN.fullmatch(uid) and _NUMBER.fullmatch(slot)):
        return None
    return ReplicaId(uid, int(slot), int(generation)) if _NUMBER.fullmatch(generation) else None


def usd_per_hour(found: Mapping[str, str]) -> float:
    """Return the price in the labels; 0 if there is none."""
    text = found.get(PRICE, "")
    return int(text) / 1e6 if text.isascii() and text.isdigit() else 0.0


def link_port(found: Mapping[str, str]) -> int:
    """Return the link's port in the labels; the default port if there is none."""
    text = found.get(PORT, "")
    return int(text) if _NUMBER.fullmatch(text) else LINK_PORT


def label_value(text: str) -> str:
    """Convert a text to a label value: lower case, at most 63 characters."""
    return _NOT_A_LABEL.sub("_", text.lower())[:63]


def infra(placement: Placement) -> str:
    """Return a placement in SkyPilot's `infra` syntax: ``aws/us-west-2/us-west-2a``."""
    return "/".join(part for part in (placement.cloud, placement.region, placement.zone) if part)
