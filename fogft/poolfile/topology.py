"""Judge the `topology` section of a pool file: gateways, and who goes through which."""

from __future__ import annotations

from collections.abc import Sequence

from fogft.model.certificate_holder import NAME_PATTERN
from fogft.model.endpoint import is_endpoint
from fogft.model.names import gateway_slot
from fogft.model.spec import ServiceSpec
from fogft.model.topology import GATEWAYS_LIMIT, ROBOTS_LIMIT, Gateway, Topology, find_loop
from fogft.poolfile.keys import GATEWAY_KEYS, ROBOT_KEYS, TOPOLOGY_KEYS
from fogft.poolfile.tree import Section, shown

_GATEWAYS_HINT = "write a list, such as `gateways: [{name: edge, endpoint: edge.example.org:7470}]`"
_ROBOTS_HINT = "write a list, such as `robots: [{name: ada, through: [edge]}]`"


def read_topology(ours: Section, services: Sequence[ServiceSpec]) -> Topology:
    """Return who talks through whom.

    Raises:
        SpecError: The first mistake; a loop of gateways is one.
    """
    if "topology" not in ours.children:
        return Topology()
    section = ours.section("topology", f"write a map with `gateways`: {_GATEWAYS_HINT}")
    section.only(TOPOLOGY_KEYS)
    below = section.sections("gateways", _GATEWAYS_HINT)
    if len(below) > GATEWAYS_LIMIT:
        raise section.error("gateways", f"has more than {GATEWAYS_LIMIT}", "use fewer")
    gateways = [_gateway(one) for one in below]
    _check_names(below, [g.name for g in gateways])
    known = [gateway.name for gateway in gateways]
    _check_slots(below, known)
    for one, gateway in zip(below, gateways, strict=True):
        _check_known(one, gateway.through, known)
    loop = find_loop({gateway.name: gateway.through for gateway in gateways})
    if loop:
        what = f"the gateways form a loop: {' -> '.join(loop)}"
        raise section.error("gateways", what, f"remove `{loop[1]}` from `through` of `{loop[0]}`")
    topology = Topology(
        tuple(gateways), _robots(section, known), _through(section, "the gateways of all robots")
    )
    _check_known(section, topology.through, known)
    _check_services(ours, services)
    if "rendezvous" not in ours.children:
        raise ours.error(
            "topology",
            "needs a `rendezvous`: gateways learn there where replicas are",
            "add one, such as `rendezvous: [meet.example.org:7450]`",
        )
    return topology


def _gateway(section: Section) -> Gateway:
    section.only(GATEWAY_KEYS)
    hint = "write where robots reach it, such as `endpoint: edge.example.org:7470`"
    endpoint = section.text("endpoint", hint)
    if not is_endpoint(endpoint):
        raise section.error("endpoint", f"{shown(endpoint)} is not `host:port`", hint)
    return Gateway(_name(section), endpoint, _through(section, "the gateways that it goes through"))


def _robots(section: Section, known: Sequence[str]) -> dict[str, tuple[str, ...]]:
    if "robots" not in section.children:
        return {}
    below = section.sections("robots", _ROBOTS_HINT)
    if len(below) > ROBOTS_LIMIT:
        raise section.error("robots", f"has more than {ROBOTS_LIMIT}", "use `through` for most")
    found = {}
    for one in below:
        one.only(ROBOT_KEYS)
        if "through" not in one.children:
            hint = "write `through: [edge]`, or `through: []` for the replicas themselves"
            raise one.error("through", "is missing", hint)
        name, through = _name(one), _through(one, "the gateways that it goes through")
        _check_known(one, through, known)
        if name in found:
            raise one.error("name", f"`{name}` stands here twice", "give each robot one entry")
        found[name] = through
    return found


def _name(section: Section) -> str:
    hint = "write its name, as in `fogft credentials issue`"
    name = section.text("name", hint)
    if not NAME_PATTERN.fullmatch(name):
        what = f"{shown(name)} is not a name"
        raise section.error("name", what, "use letters, digits and dashes, 28 at most")
    return name


def _through(section: Section, what: str) -> tuple[str, ...]:
    if "through" not in section.children:
        return ()
    listed = section.children["through"].value
    if not isinstance(listed, tuple) or not all(isinstance(one.value, str) for one in listed):
        raise section.error("through", "must be a list of names", f"list {what}: `through: [edge]`")
    names = tuple(str(one.value) for one in listed)
    if len(set(names)) < len(names):
        raise section.error("through", "has a gateway twice", "list each of them once")
    return names


def _check_names(below: Sequence[Section], names: Sequence[str]) -> None:
    for at, name in enumerate(names):
        if name in names[:at]:
            raise below[at].error("name", f"`{name}` stands here twice", "give each its own name")


def _check_slots(below: Sequence[Section], names: Sequence[str]) -> None:
    slots: dict[int, str] = {}
    for section, name in zip(below, names, strict=True):
        other = slots.setdefault(gateway_slot(name), name)
        if other != name:
            what = f"`{name}` has the same number as `{other}`, which is made from the name"
            raise section.error("name", what, "use another name")


def _check_known(section: Section, through: Sequence[str], known: Sequence[str]) -> None:
    for name in through:
        if name not in known:
            hint = "known here: " + ", ".join(f"`{one}`" for one in known)
            raise section.error("through", f"there is no gateway {shown(name)}", hint)


def _check_services(ours: Section, services: Sequence[ServiceSpec]) -> None:
    for service in services:
        key = "state" if service.state is not None else "quorum" if service.quorum > 1 else ""
        if key:
            raise ours.error(
                "topology",
                f"does not go with service `{service.name}`, which has `{key}`",
                "put that service into a pool of its own: the robot must ask each replica itself",
            )
