"""A proxy's ROS node and type support, through rclpy or rmw_zenoh.

With rclpy, a type is defined by its installed package. Over Zenoh, it is identified by the hash
that nodes write into their names; its fields are known only if its package is installed too.
"""

import contextlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from fogft.errors import RosError
from fogft.model.cdr import Shape
from fogft.model.choices import Speaks
from fogft.model.type_definition import Definition
from fogft.process import load_numpy
from fogft.ros import environment, memory_tuning
from fogft.ros.joining import EarlyJoin
from fogft.ros.port import RosNode
from fogft.ros.visible import VisibleNode

Judge = Callable[[Mapping[str, Any]], str]


class Joined(NamedTuple):
    """A node, its type definitions, and a factory of the node visible to people.

    Over Zenoh there is no visible node: `/diagnostics` and parameters need types.

    `participant` returns the DDS participant id of the node offering a service here; `callers`
    counts the clients that may call it; both are empty if unknown. `identity` returns, for a
    request's handle, an id of the request that is the same in every process that received it.
    """

    node: RosNode
    define: Callable[[str], Definition]
    make_visible: Callable[[str, Judge], VisibleNode | None] = lambda name, judge: None
    participant: Callable[[str], bytes] = lambda service: b""
    callers: Callable[[str], int] = lambda service: 0
    identity: Callable[[Any], Any] = lambda handle: handle


def prepare(speaks: Speaks) -> None:
    """Prepare this process for ROS. Call it before anything else."""
    if speaks is Speaks.RCLPY:
        environment.prepare(os.environ)
        load_numpy()
    memory_tuning.tune()


def join_early(speaks: Speaks, name: str, domain_id: int | None) -> EarlyJoin | None:
    """Join the ROS domain early, before any service is offered. Raises RosError."""
    return EarlyJoin(f"_{name}_standby", domain_id) if speaks is Speaks.RCLPY else None


def load_types(type_names: Sequence[str]) -> None:
    """Preload the available ones of these service types; errors are left to those who use them."""
    from fogft.ros import messages, types
    from fogft.ros.serialised import self_test

    for name in type_names:
        with contextlib.suppress(ImportError, RosError):
            types.definition(name)
            messages.default_response(name)
            self_test()


def join(
    speaks: Speaks,
    name: str,
    domain_id: int | None,
    *,
    early: EarlyJoin | None = None,
    told: Callable[[], Mapping[str, Sequence[Definition]]] = dict,
    noticed: Callable[[], None] = lambda: None,
    environ: Mapping[str, str] = os.environ,
) -> Joined:
    """Create a node. Raises RosError: ROS, or Zenoh, is not usable here.

    Args:
        told: Returns the type definitions reported by each replica.
        noticed: Called, from any thread, when a type may have become known.
        environ: The environment with the ROS and Zenoh variables; used with Zenoh only.
    """
    from fogft.ros.types import definition

    if speaks is Speaks.RCLPY:
        from fogft.ros.node import SerialisedNode

        serialised = SerialisedNode(name, domain_id, early=early)
        seen = serialised.make_visible, serialised.participant, serialised.callers
        return Joined(serialised, definition, *seen, serialised.identity)
    from fogft.rmw_zenoh.node import RmwZenohNode

    def hashes_of(type_name: str) -> list[str]:
        ours = definition(type_name)
        known = [ours] if ours.service_hash else told().get(type_name, ())
        return [one.service_hash for one in known if one.service_hash]

    node = RmwZenohNode(
        name, domain_id, hashes_of=hashes_of, fault_of=fault_of, noticed=noticed, environ=environ
    )

    def define(type_name: str) -> Definition:
        found, hash = definition(type_name), node.graph.hash_of(type_name)
        if found.trouble:  # its package is not installed, and need not be
            return Definition(service_hash=hash)
        return replace(found, service_hash=hash or found.service_hash)

    return Joined(node, define)


def fault_of(type_name: str, part: str) -> Callable[[bytes], str]:
    """Return a check of a type's serialised `part`; if the type is unavailable, of headers only."""
    from fogft.ros.types import load_service_type, shape

    try:  # the same shape is used again when a message is sent
        return shape(getattr(load_service_type(type_name), part.capitalize())).fault
    except RosError:
        return Shape(part, {}).fault


def empty_response(speaks: Speaks, type_name: str, *, needed: bool) -> bytes | None:
    """Return a type's default response; None if it is not needed. Raises RosError."""
    try:
        from fogft.ros import messages

        return messages.default_response(type_name)
    except (ImportError, RosError) as error:
        if not needed and speaks is not Speaks.RCLPY:
            return None
        if isinstance(error, RosError):
            raise
        raise RosError(
            f"`{type_name}` cannot be loaded here: {error}",
            "install `fogft[ros]` and the package of that type, or source a workspace with it",
        ) from error
