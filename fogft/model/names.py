"""Identifiers that both ends derive: Zenoh keys, certificate names, request ids.

A connection is identified by pool, slot, service and type, never by an address, so a replica
that is relaunched elsewhere resumes the same connection.

Source: FogROS2-SGC's construction of identifiers, extended to connections by FogROS2-FT.
"""

import hashlib
import re
from collections.abc import Mapping
from typing import Annotated

from fogft.model.keys import Text, only

REQUEST_ID_BYTES = 16
GATEWAY_SLOTS = 1 << 32  # slots from here on belong to gateways
# SkyPilot's names of clouds, kept so that reading a pool file needs no SkyPilot;
# `tests/sky/test_installed.py` compares them with the installed version's.
VM_CLOUDS = (
    *("aws", "azure", "cudo", "do", "fluidstack", "gcp", "hyperbolic", "ibm", "lambda", "mithril"),
    *("nebius", "oci", "paperspace", "primeintellect", "runpod", "scp", "seeweb", "shadeform"),
    *("vast", "verda", "vsphere", "yotta"),
)
# SkyPilot can use them, but they have no machines of their own to replicate on.
NO_VM_CLOUDS = ("k8s", "kubernetes", "slurm", "ssh")
# Where a replica may learn that its machine will be preempted; also `file:PATH` and `none`.
NOTICE_SOURCES = ("auto", "aws", "azure", "gcp")
ROBOT_BYTES_LIMIT = 64  # of a robot's name
POOL_UID_PATTERN = re.compile(r"[0-9a-f]{16}")
PoolUid = Annotated[str, only(POOL_UID_PATTERN.fullmatch, "16 hexadecimal digits")]
POOL_NAME_PATTERN = re.compile(r"[a-z0-9]([a-z0-9-]{0,38}[a-z0-9])?")


def connection_id(pool_uid: str, slot: int, service: str, type_name: str) -> str:
    """Return the 32 hexadecimal digits that permanently identify a connection."""
    digest = hashlib.sha256()
    for part in (pool_uid, str(slot), service, type_name):
        encoded = part.encode()
        digest.update(len(encoded).to_bytes(4, "big") + encoded)
    return digest.hexdigest()[:32]


# Suffixes of a slot's keys: queries that carry a connection's answers, probes, signed records,
# ids of requests that are no longer wanted, and all of its services.
ANSWERS, PROBE, RECORDS, CANCEL, SERVICES = "answers", "probe", "records", "cancel", "s/*"


def slot_key(pool_uid: str, slot: int, what: str) -> str:
    """Return a Zenoh key of a slot; a slot may serve only keys of this form."""
    return f"fogft/{pool_uid}/{slot}/{what}"


def service_key(pool_uid: str, slot: int, service: str, type_name: str) -> str:
    """Return the Zenoh key at which a slot receives requests of a service."""
    id = connection_id(pool_uid, slot, service, type_name)
    return slot_key(pool_uid, slot, f"s/{id}")


def service_keys(pool_uid: str, slot: int, types: Mapping[str, str]) -> dict[str, str]:
    """Return a slot's Zenoh key for each service, given the type of each."""
    return {name: service_key(pool_uid, slot, name, kind) for name, kind in types.items()}


def gateway_slot(gateway: str) -> int:
    """Return the slot of a gateway, which robots treat like a replica."""
    # The pool file's reader refuses two names that share one.
    digest = hashlib.sha256(f"gateway {gateway}".encode()).digest()
    return GATEWAY_SLOTS + int.from_bytes(digest[:4], "big")


def is_endpoint(text: str) -> bool:
    """Whether a text is ``host:port``; IPv6 addresses are in brackets."""
    host, _, port = text.rpartition(":")
    in_brackets = host.startswith("[") and host.endswith("]")
    if not host or len(host) > 255 or not (in_brackets or ":" not in host):
        return False
    if not host.isascii() or not host.isprintable():
        return False
    if not all(0 < len(label) < 64 for label in host.removesuffix(".").split(".")):
        return False  # Python raises ValueError for such a name
    return len(port) <= 5 and port.isascii() and port.isdigit() and 0 < int(port) < 65_536


def endpoint(hint: str) -> Text:
    """Return the form of a key that holds an endpoint."""
    return Text("`host:port`", hint, only(is_endpoint))


def host_and_port(endpoint: str) -> tuple[str, int]:
    """Return both parts of ``host:port``, an IPv6 address without brackets. Raises ValueError."""
    host, _, port = endpoint.rpartition(":")
    return host.strip("[]"), int(port)


Endpoint = Annotated[str, only(is_endpoint, "`host:port`")]
EndpointOrEmpty = Annotated[str, only(lambda text: not text or is_endpoint(text), "`host:port`")]

SETUP_LIMIT_S = 3600
"""How long from its launch a machine's set-up may take. Kept by the machine itself on a real cloud,
by who follows its launch, and by the planner. Seconds."""

NAMES_BYTES_LIMIT = 64 << 10
"""Limit on a pool's service and topic names: each probe's answer lists those that work."""
LINK_PORT = 7448
"""Where a server proxy listens unless told otherwise; 7447 is the port of `rmw_zenoh`'s router."""
