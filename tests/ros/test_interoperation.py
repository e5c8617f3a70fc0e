"""Ordinary rclpy nodes and ours, in processes of their own, with and without our DDS profile."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fogft.ros.environment import profile_path, profile_variable

from .conftest import LIMIT_S, wait_for

pytestmark = pytest.mark.ros

SET_MAP = "nav_msgs/srv/SetMap"
CELLS = 900_000  # one byte each: larger than Fast DDS's default shared-memory segment
SCRIPT = Path(__file__).parent / "nodes" / "ordinary.py"


@pytest.fixture
def ordinary(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start `ordinary.py` with the shipped profile, or with Fast DDS's defaults."""
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: object, profile: bool) -> subprocess.Popen[str]:
        environ = {**os.environ, profile_variable(): str(profile_path())}
        environ["ROS_LOG_DIR"] = str(tmp_path)
        if not profile:
            del environ[profile_variable()]
        process = subprocess.Popen(
            [sys.executable, str(SCRIPT), *map(str, arguments)],
            env=environ,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                stream.close()


def _map_request(cells: int) -> bytes:
    from nav_msgs.srv import SetMap
    from rclpy.serialization import serialize_message

    request = SetMap.Request()
    request.map.info.width = cells
    request.map.data = [value % 101 for value in range(cells)]
    return bytes(serialize_message(request))


def _success(payload: bytes) -> bool:
    from nav_msgs.srv import SetMap
    from rclpy.serialization import deserialize_message

    return bool(deserialize_message(payload, SetMap.Response).success)


@pytest.mark.parametrize("profile", [True, False], ids=["profile", "default-transports"])
def test_our_client_calls_an_ordinary_service(
    ordinary: Callable[..., Any], make_node: Callable[[int], Any], ros_domain: int, profile: bool
) -> None:
    """0.9 MB arrive whole at a service that knows nothing of us."""
    service = ordinary("serve", ros_domain, profile=profile)
    assert service.stdout.readline() == "ready\n"
    client = make_node(ros_domain).client("/map", SET_MAP)
    wait_for(client.available, "discovery")
    wait_for(client.is_known, "its discovery of us: an ordinary service would drop the response")
    answers: list[bytes] = []
    client.call(_map_request(CELLS), answers.append)
    wait_for(lambda: answers, "the response")
    assert _success(answers[0])


@pytest.mark.parametrize("profile", [True, False], ids=["profile", "default-transports"])
def test_an_ordinary_client_calls_our_service(
    ordinary: Callable[..., Any], make_node: Callable[[int], Any], ros_domain: int, profile: bool
) -> None:
    """A user's client finds our service, and 0.9 MB arrive whole at us."""
    from nav_msgs.srv import SetMap
    from rclpy.serialization import deserialize_message, serialize_message

    requests: list[bytes] = []

    def on_request(payload: bytes, handle: Any) -> None:
        requests.append(payload)
        server.respond(handle, bytes(serialize_message(SetMap.Response(success=True))))

    server = make_node(ros_domain).serve("/map", SET_MAP, on_request)
    caller = ordinary("call", ros_domain, CELLS, profile=profile)
    answer, _ = caller.communicate(timeout=LIMIT_S)
    assert answer == "True\n"
    received = deserialize_message(requests[0], SetMap.Request)
    assert received.map.data.tolist() == [value % 101 for value in range(CELLS)]


def test_an_ordinary_service_that_dies_is_noticed(
    ordinary: Callable[..., Any], make_node: Callable[[int], Any], ros_domain: int
) -> None:
    """A service that ends in order is unavailable at once, not after discovery's lease."""
    service = ordinary("serve", ros_domain, profile=True)
    client = make_node(ros_domain).client("/map", SET_MAP)
    wait_for(client.available, "discovery")
    service.stdin.close()
    wait_for(lambda: not client.available(), "the service to be gone")
    assert service.wait(LIMIT_S) == 0


def test_a_client_that_is_gone_is_no_error(
    ordinary: Callable[..., Any], make_node: Callable[[int], Any], ros_domain: int
) -> None:
    """A response to a caller that was killed meanwhile is dropped in silence."""
    handles: list[Any] = []
    server = make_node(ros_domain).serve("/map", SET_MAP, lambda _, handle: handles.append(handle))
    caller = ordinary("call", ros_domain, 10, profile=True)
    wait_for(lambda: handles, "the request")
    caller.kill()
    caller.wait(LIMIT_S)
    assert server.respond(handles[0], b"\x00\x01\x00\x00\x01") is None


def test_domains_are_apart(make_node: Callable[[int], Any], ros_domains: Callable[[], int]) -> None:
    """A service in one domain is not seen from another, while one in the same domain is."""
    here, there = ros_domains(), ros_domains()
    make_node(there).serve("/map", SET_MAP, lambda *_: None)
    node = make_node(here)
    stranger = node.client("/map", SET_MAP)
    node.serve("/near", SET_MAP, lambda *_: None)
    near = make_node(here).client("/near", SET_MAP)
    wait_for(near.available, "discovery in the same domain")
    assert not stranger.available()
