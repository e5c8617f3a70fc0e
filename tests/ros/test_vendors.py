"""Which endpoints are on a DDS that does not understand our services."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from fogft.ros.vendors import CYCLONE_DDS, FAST_DDS, of_client, of_server, strangers
from tests.needs import needs

from .conftest import SET_BOOL, wait_for

FAST, CYCLONE = "rmw_fastrtps_cpp", "rmw_cyclonedds_cpp"
A_FAST, A_CYCLONE, ANOTHER = FAST_DDS + b"abc", CYCLONE_DDS + b"abc", b"\x01\x01abc"


@pytest.mark.parametrize(
    ("ours", "identifiers", "found"),
    [
        (FAST, [], []),
        (FAST, [A_FAST], []),
        (FAST, [A_CYCLONE, A_FAST], [CYCLONE]),
        (CYCLONE, [A_CYCLONE, A_FAST], [FAST]),
        ("rmw_fastrtps_dynamic_cpp", [A_FAST, A_CYCLONE], [CYCLONE]),
        (FAST, [ANOTHER, b"", b"\x01"], []),
        ("rmw_connextdds", [A_FAST, A_CYCLONE], []),
        ("rmw_zenoh_cpp", [A_CYCLONE], []),  # hashes there, which may begin with anything
    ],
)
def test_strangers_are_told_by_the_first_two_bytes(
    ours: str, identifiers: list[bytes], found: list[str]
) -> None:
    """Nothing is said of a middleware that we know nothing of."""
    assert strangers(ours, identifiers) == found


def test_what_to_set_is_said() -> None:
    assert f"RMW_IMPLEMENTATION={FAST}" in of_client("/s", FAST, CYCLONE)
    assert "envs: {RMW_IMPLEMENTATION" in of_server("/s", FAST, CYCLONE)


# As ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST has it.
ON_THIS_MACHINE = (
    "<General><Interfaces><NetworkInterface name='lo'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery>"
    "<ParticipantIndex>auto</ParticipantIndex>"
    "<Peers><Peer Address='localhost'/></Peers></Discovery>"
)


@contextmanager
def cyclone(what: str, domain: int) -> Iterator[None]:
    command = [
        sys.executable,
        str(Path(__file__).parent / "nodes" / "cyclone_end.py"),
        what,
        "flag",
    ]
    environ = {**os.environ, "ROS_DOMAIN_ID": str(domain), "CYCLONEDDS_URI": ON_THIS_MACHINE}
    with subprocess.Popen(command, stdin=subprocess.PIPE, env=environ) as process:
        try:
            yield
        finally:
            assert process.stdin is not None
            process.stdin.close()
            process.wait(30)


@pytest.mark.ros
def test_whoever_offers_the_same_service_is_named(
    make_node: Callable[[int], Any], ros_domain: int
) -> None:
    """Another pool, or a node of the robot's: each request would go to both, unsaid."""
    first, second = (
        make_node(ros_domain).serve("/flag", SET_BOOL, lambda payload, handle: None)
        for _ in range(2)
    )
    wait_for(first.mismatch, "the second")
    assert "`/flag` is also offered by `/ours_1`" in first.mismatch()
    wait_for(second.mismatch, "the first")
    first.close()
    wait_for(lambda: not second.mismatch(), "its end")


@pytest.mark.ros
@needs("rclpy", "fastdds", "cyclonedds")
def test_real_ends_on_cyclone_dds_are_told(
    make_node: Callable[[int], Any], ros_domain: int
) -> None:
    """A client of ours hears that its service cannot be called, a service that its client waits."""
    node = make_node(ros_domain)
    client = node.client("/flag", SET_BOOL)
    with cyclone("server", ros_domain):
        wait_for(client.available, "the service on CycloneDDS")
        assert f"`/flag` runs on {CYCLONE}" in client.mismatch()
        server = make_node(ros_domain).serve("/flag", SET_BOOL, lambda payload, handle: None)
        wait_for(lambda: not client.mismatch(), "one that can be called, beside it")
        assert not server.mismatch()
    with cyclone("client", ros_domain):
        wait_for(server.mismatch, "the client on CycloneDDS")
        assert f"a client of `/flag` runs on {CYCLONE}" in server.mismatch()
    wait_for(lambda: not server.mismatch(), "its end")
