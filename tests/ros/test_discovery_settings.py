"""Proxies' ends find each other, or do not, as ROS's own variables say; bursts lose nothing."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fogft.ros import environment
from tests.link.namespaces import Namespaces

pytestmark = pytest.mark.ros
SCRIPT = Path(__file__).parent / "nodes" / "ours.py"
SETTINGS = ("ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS")
IN_FLIGHT = 100  # a service's default history would lose most of them

Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def start(ros_domain: int, tmp_path: Path) -> Iterator[Start]:
    """Start `ours.py` with some of ROS's variables, in a namespace or none."""
    started: list[subprocess.Popen[str]] = []

    def begin(*words: object, where: str = "", **variables: str) -> subprocess.Popen[str]:
        environ = {k: v for k, v in os.environ.items() if k not in SETTINGS}
        environ |= {"ROS_DOMAIN_ID": str(ros_domain), "ROS_LOG_DIR": str(tmp_path), **variables}
        environ = {name: value for name, value in environ.items() if value}
        inside = ["ip", "netns", "exec", where] if where else []
        process = subprocess.Popen(
            [*inside, sys.executable, str(SCRIPT), *map(str, words)],
            env=environ, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        started.append(process)
        return process

    yield begin
    for process in started:
        process.kill()
        process.communicate()


def serving(start: Start, **options: str) -> None:
    process = start("serve", **options)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"


def answered(start: Start, limit_s: float = 20, **options: str) -> int:
    out, _ = start("call", IN_FLIGHT, limit_s, **options).communicate(timeout=90)
    return int(out)


@pytest.mark.parametrize(
    "variables",
    [
        {},
        {"ROS_LOCALHOST_ONLY": "1"},
        {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
        {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "ROS_STATIC_PEERS": "127.0.0.1"},
        {environment.profile_variable(): "", "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"},
    ],
    ids=["a domain", "localhost only", "range", "static peers", "the user's transports"],
)
def test_a_burst_of_a_hundred_loses_none(start: Start, variables: dict[str, str]) -> None:
    """More than a default queue holds, under every setting of discovery."""
    serving(start, **variables)
    assert answered(start, **variables) == IN_FLIGHT


def test_another_domain_is_not_found(start: Start, ros_domains: Callable[[], int]) -> None:
    serving(start)
    assert answered(start, limit_s=3, ROS_DOMAIN_ID=str(ros_domains())) == 0


def test_with_discovery_off_nothing_is_found(start: Start) -> None:
    serving(start, ROS_AUTOMATIC_DISCOVERY_RANGE="OFF")
    assert answered(start, limit_s=3, ROS_AUTOMATIC_DISCOVERY_RANGE="OFF") == 0


def test_static_peers_are_found_where_there_is_no_multicast(net: Namespaces, start: Start) -> None:
    """Two machines whose network carries no multicast: only the peers that are named find one."""
    here, there = net.add("ros-here"), net.add("ros-there")
    cables = net.join(here, "10.99.7.1", there, "10.99.7.2")
    for space, cable in zip((here, there), cables, strict=True):
        words = ["ip", "-n", space, "link", "set", cable, "multicast", "off"]
        subprocess.run(words, check=True)
    # Shared memory would join two namespaces of one machine behind the network's back.
    only_udp = {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4", environment.profile_variable(): ""}
    alone = {**only_udp, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    serving(start, where=there, ROS_STATIC_PEERS="10.99.7.1", **alone)
    assert answered(start, where=here, ROS_STATIC_PEERS="10.99.7.2", **alone) == IN_FLIGHT


def test_without_named_peers_and_multicast_nothing_is_found(net: Namespaces, start: Start) -> None:
    here, there = net.add("ros-here"), net.add("ros-there")
    net.join(here, "10.99.8.1", there, "10.99.8.2")
    only_udp = {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4", environment.profile_variable(): ""}
    alone = {**only_udp, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    serving(start, where=there, **alone)
    assert answered(start, limit_s=3, where=here, **alone) == 0
