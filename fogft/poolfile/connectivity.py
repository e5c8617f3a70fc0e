"""Judge `rendezvous`, `dial_in`, `uplinks`, `metrics`, `rmw`: how a pool's parts are reached."""

from __future__ import annotations

from collections.abc import Mapping

from fogft.model.choices import MetricsSpec
from fogft.model.endpoint import is_endpoint
from fogft.model.middleware import Middleware, Speaks
from fogft.model.uplinks import is_interface
from fogft.poolfile.keys import METRICS_KEYS, RMW_KEYS
from fogft.poolfile.tree import Section, shown

MAX_RENDEZVOUS = 4
MAX_UPLINKS = 4
_LAST_REPLICA_PORT = 65535 - 1000  # slots that the manager launches go up to 999
_UPLINKS_HINT = "write what `ip link` lists, such as `uplinks: [wlan0, wwan0]`"
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


def read_uplinks(ours: Section) -> tuple[str, ...]:
    """Return the robot's network interfaces, the preferred one first.

    Raises:
        SpecError: They are none.
    """
    if "uplinks" not in ours.children:
        return ()
    listed = ours.children["uplinks"].value
    if not isinstance(listed, tuple) or not listed:
        raise ours.error("uplinks", "must be a list of network interfaces", _UPLINKS_HINT)
    found = []
    for node in listed:
        if not isinstance(node.value, str) or not is_interface(node.value):
            what = f"{shown(node.value)} is not a network interface's name"
            raise ours.error("uplinks", what, _UPLINKS_HINT)
        if node.value in found:
            raise ours.error("uplinks", f"has `{node.value}` twice", "list each of them once")
        found.append(node.value)
    if len(found) > MAX_UPLINKS:
        raise ours.error("uplinks", f"has {len(found)}", f"list {MAX_UPLINKS} at most")
    return tuple(found)


def read_metrics(ours: Section) -> MetricsSpec:
    """Return where processes listen for Prometheus.

    Raises:
        SpecError: It is no endpoint, or one is there twice.
    """
    example = "write an address that only your Prometheus reaches, such as `{}: 127.0.0.1:{}`"
    section = ours.section("metrics", "write a map, such as `metrics: {proxy: 127.0.0.1:9464}`")
    section.only(METRICS_KEYS)
    found: dict[str, str] = {}
    for number, key in enumerate(METRICS_KEYS):
        if key not in section.children:
            continue
        value = section.children[key].value
        endpoint = _endpoint(section, key, value, example.format(key, 9464 + number))
        if endpoint in found.values():
            raise section.error(key, f"`{endpoint}` stands here twice", "give each its own port")
        found[key] = endpoint
    if "replica" in found and int(found["replica"].rpartition(":")[2]) > _LAST_REPLICA_PORT:
        what = "leaves no room: replica SLOT has this port plus SLOT, which would be above 65535"
        raise section.error("replica", what, f"write a port up to {_LAST_REPLICA_PORT}")
    return MetricsSpec(**found)


def read_rmw(ours: Section) -> Middleware:
    """Return how the proxies speak ROS: one way for all, or one for each side.

    Raises:
        SpecError: It is none of the ways there are.
    """
    node = ours.children.get("rmw")
    if node is None or not isinstance(node.value, Mapping):
        both = ours.choice("rmw", Speaks.RCLPY)
        return Middleware(both, both)
    section = ours.section("rmw")
    section.only(RMW_KEYS)
    return Middleware(
        section.choice("robot", Speaks.RCLPY), section.choice("replica", Speaks.RCLPY)
    )


def _endpoint(ours: Section, key: str, value: object, hint: str) -> str:
    if not isinstance(value, str) or not is_endpoint(value):
        raise ours.error(key, f"{shown(value)} is not `host:port`", hint)
    return value
