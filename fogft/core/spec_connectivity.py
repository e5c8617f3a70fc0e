"""Judge `rendezvous` and `dial_in` of a pool file: where the parts of a pool find each other."""

from __future__ import annotations

from fogft.core.membership import is_endpoint
from fogft.core.spec_tree import Section, shown

MAX_RENDEZVOUS = 4
_RENDEZVOUS_HINT = "write a list, such as `rendezvous: [meet.example.org:7450]`"
_DIAL_IN_HINT = (
    "write the robot's own address and a port, such as `dial_in: robot.example.org:7460`"
)


def read_rendezvous(ours: Section) -> tuple[str, ...]:
    """Return the endpoints of the rendezvous.

    Raises:
        SpecError: They are none.
    """
    if "rendezvous" not in ours.children:
        return ()
    listed = ours.children["rendezvous"].value
    if not isinstance(listed, tuple) or not listed:
        raise ours.error("rendezvous", "must be a list of endpoints", _RENDEZVOUS_HINT)
    found = [_endpoint(ours, "rendezvous", node.value, _RENDEZVOUS_HINT) for node in listed]
    if len(set(found)) < len(found):
        raise ours.error("rendezvous", "has an endpoint twice", "list each of them once")
    if len(found) > MAX_RENDEZVOUS:
        raise ours.error(
            "rendezvous", f"has {len(found)} endpoints", f"list {MAX_RENDEZVOUS} at most; two do"
        )
    return tuple(found)


def read_dial_in(ours: Section) -> str:
    """Return where replicas dial the robot; empty where the robot dials them.

    Raises:
        SpecError: It is no endpoint.
    """
    if "dial_in" not in ours.children:
        return ""
    return _endpoint(ours, "dial_in", ours.children["dial_in"].value, _DIAL_IN_HINT)


def _endpoint(ours: Section, key: str, value: object, hint: str) -> str:
    if not isinstance(value, str) or not is_endpoint(value):
        raise ours.error(key, f"{shown(value)} is not `host:port`", hint)
    return value
