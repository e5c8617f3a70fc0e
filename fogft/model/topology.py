"""Gateways: their upstream gateways, and the robots that use them. Pure.

A robot that uses gateways holds links to them and to no replica. A gateway may forward to other
gateways; a loop is refused wherever a topology is read.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from graphlib import CycleError, TopologicalSorter
from typing import Any

from fogft.model.credentials import NAME_PATTERN, Holder, Role
from fogft.model.keys import Flag, Free, Listed, Maps, Text, Whole, key, only
from fogft.model.names import endpoint as named_endpoint
from fogft.model.plain import Generation

GATEWAYS_LIMIT = 64
ROBOTS_LIMIT = 512
LAUNCHED = "gateway"  # the name of the gateway that a pool launches for itself

_NAME = Text("a name", "use letters, digits and dashes, 28 at most", only(NAME_PATTERN.fullmatch))
_NAMES = Listed(_NAME, GATEWAYS_LIMIT, least=0)


@dataclass(frozen=True)
class Gateway:
    """A gateway as the pool file describes it."""

    name: str = key(_NAME, "Name of the gateway, as in its certificate.")
    endpoint: str = key(
        named_endpoint("write where robots reach it, such as `endpoint: edge.example.org:7470`"),
        "Address at which robots and other gateways reach it.",
    )
    through: tuple[str, ...] = key(
        _NAMES,
        "Gateways that it forwards requests to; if empty, the replicas. A loop is an error.",
        name="upstream",
        default=(),
        usual="the replicas",
    )
    generations: tuple[Generation, ...] = ()  # of its valid certificates; two during a rotation


@dataclass(frozen=True)
class LaunchedGateway:
    """The gateway that a pool launches for itself, for robots and replicas that both dial it."""

    launch: bool = key(
        Flag(),
        "Launch a gateway on an on-demand VM. Robots and replicas both dial it, so neither needs a "
        "public address. Instead of `topology`, `rendezvous` and `dial_in`.",
        default=False,
    )
    resources: Mapping[str, Any] = key(
        Free("write resources as at the top level"),
        "The gateway's VM: where replicas may be, with `cpus: 2+`, unless overridden here.",
        default_factory=dict,
    )
    port: int = key(
        Whole(1024, 65533),
        "Port that robots dial; the next two are the rendezvous's and the replicas'.",
        default=7470,
    )

    def endpoints(self, host: str) -> tuple[str, str, str]:
        """Return the addresses for robots, for its rendezvous, and for replicas that dial in."""
        gateway, rendezvous, door = (f"{host}:{self.port + n}" for n in range(3))
        return gateway, rendezvous, door


@dataclass(frozen=True)
class RobotRoute:
    """The gateways of one robot."""

    name: str = key(_NAME, "Name of the robot, as in its certificate.")
    gateways: tuple[str, ...] = key(
        _NAMES, ("Gateways of the robot; `[]` for the replicas themselves.")
    )


@dataclass(frozen=True)
class Topology:
    """The gateways of a pool, and which of them each robot uses (`routes`, else the default)."""

    gateways: tuple[Gateway, ...] = key(
        Maps(
            Gateway,
            "write a list, such as `gateways: [{name: edge, endpoint: edge.example.org:7470}]`",
            GATEWAYS_LIMIT,
        ),
        "The gateways of the pool.",
        default=(),
        usual="required",
    )
    routes: tuple[RobotRoute, ...] = key(
        Maps(
            RobotRoute,
            "write a list, such as `robots: [{name: ada, gateways: [edge]}]`",
            ROBOTS_LIMIT,
        ),
        "Robots that do not use `default_gateways`.",
        name="robots",
        default=(),
    )
    through: tuple[str, ...] = key(
        _NAMES,
        "Gateways of every robot not listed in `robots`; if empty, the replicas themselves. With "
        "several, a request goes to one, and to another if it is late or lost.",
        name="default_gateways",
        default=(),
        usual="the replicas",
    )

    @property
    def robots(self) -> dict[str, tuple[str, ...]]:
        """Robot name -> its gateways; empty for the replicas themselves."""
        return {route.name: route.gateways for route in self.routes}

    def __bool__(self) -> bool:
        """Whether there is any gateway."""
        return bool(self.gateways)

    def neighbours(self, holder: Holder) -> tuple[Gateway, ...]:
        """Return the gateways that a robot or gateway connects to; if empty, the replicas.

        Gateways without a valid certificate are left out.
        """
        if holder.role is Role.GATEWAY:
            listed = next((g.through for g in self.gateways if g.name == holder.name), ())
        else:
            listed = self.robots.get(holder.name, self.through)
        return tuple(g for g in self.gateways if g.name in listed and g.generations)


def certified(topology: Topology, generations: Mapping[str, Iterable[int]]) -> Topology:
    """Return a topology with the generations of each gateway's valid certificates."""
    gateways = tuple(
        replace(g, generations=tuple(sorted(generations.get(g.name, ()))))
        for g in topology.gateways
    )
    return replace(topology, gateways=gateways)


def trouble(topology: Topology) -> str:
    """Return the problem with a topology, in words; empty if it is valid."""
    known = {gateway.name for gateway in topology.gateways}
    if len(known) < len(topology.gateways):
        return "a gateway is defined twice"
    lists = [*(g.through for g in topology.gateways), *topology.robots.values(), topology.through]
    for listed in lists:
        if len(set(listed)) < len(listed):
            return "a gateway is listed twice in one `through`"
        for name in listed:
            if name not in known:
                return f"there is no gateway `{name}`"
    loop = find_loop({gateway.name: gateway.through for gateway in topology.gateways})
    return f"the gateways form a loop: {' -> '.join(loop)}" if loop else ""


def find_loop(through: Mapping[str, Iterable[str]]) -> list[str]:
    """Return the names along a loop, the first one repeated at the end; empty without a loop."""
    try:
        TopologicalSorter(through).prepare()
    except CycleError as error:
        return list(reversed(error.args[1]))
    return []
