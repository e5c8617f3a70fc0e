"""A client with ROS's default settings loses no response, whatever it asks at once.

It keeps ten that it has not taken: an ordinary service would lose most of these. The answers come
a millisecond after the requests, as replicas' do. Real rclpy clients, in processes of their own.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pytest

from fogft.ros.messages import default_response
from fogft.ros.node import SerialisedNode

from .conftest import expect_line, wait_for

pytestmark = pytest.mark.ros

TYPE = "std_srvs/srv/SetBool"
PROGRAM = str(Path(__file__).parent / "nodes" / "plain_client.py")


@pytest.fixture
def arrived(ros_domain: int) -> Iterator[list[int]]:
    """Offer ``/burst``, as a proxy does; give how many requests came.

    On a busy machine not all do: a client's requests pass a queue of ten, too.
    """
    arrived = [0]
    node = SerialisedNode("fogft_burst", ros_domain)
    response = default_response(TYPE)
    waiting: SimpleQueue[Any] = SimpleQueue()

    def take(_: bytes, handle: Any) -> None:
        arrived[0] += 1
        waiting.put(handle)

    server = node.serve("/burst", TYPE, take)

    def answer() -> None:
        while (handle := waiting.get()) is not None:
            time.sleep(0.001)
            server.respond(handle, response)

    answering = threading.Thread(target=answer, daemon=True)
    answering.start()
    yield arrived
    waiting.put(None)
    answering.join(30)
    node.close()


@pytest.fixture
def call(ros_domain: int) -> Callable[..., list[int]]:
    """Return what runs clients in the service's domain."""
    return partial(answers, ros_domain)


def answers(domain: int, *clients: tuple[int, float, int]) -> list[int]:
    """Run clients beside each other; return how many answers each got."""
    started = [start(domain, f"plain_{n}", client) for n, client in enumerate(clients)]
    time.sleep(1.0)
    try:
        for one in started:
            begin(one)
        return [int(one.communicate(timeout=120)[0]) for one in started]
    finally:
        for one in started:
            one.kill()
            one.wait()


def start(domain: int, name: str, client: tuple[int, float, int], *service: str) -> Any:
    """Start a client; return its process once it has found the service."""
    process = subprocess.Popen(
        [sys.executable, PROGRAM, name, *map(str, client), *service],
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    expect_line(process, "ready")
    return process


def begin(client: Any) -> None:
    client.stdin.write("\n")
    client.stdin.flush()


@pytest.mark.parametrize(
    ("count", "callback_s", "rounds"), [(50, 0.0, 10), (200, 0.03, 1), (1000, 0.0, 1)]
)
def test_a_burst_of_requests_loses_none(
    arrived: list[int],
    call: Callable[..., list[int]],
    count: int,
    callback_s: float,
    rounds: int,
) -> None:
    assert call((count, callback_s, rounds)) == arrived
    # What the client's own queue of ten pushes out, before anybody sees it, is no answer lost.
    assert arrived[0] > 0.5 * count * rounds


def test_two_clients_of_one_service_lose_none(
    arrived: list[int], call: Callable[..., list[int]]
) -> None:
    """They share its topic of responses: a burst of one fills the other's queue, too."""
    assert sum(call((50, 0.0, 10), (10, 0.005, 20))) == arrived[0]
    assert arrived[0] > 0.9 * 700


def test_the_successors_of_killed_clients_lose_none(arrived: list[int], ros_domain: int) -> None:
    """Each has the shared-memory port of the one before, which DDS writes to for seconds."""
    answered = sum(answers_then_killed(ros_domain, 50) for _ in range(4))
    assert answered == arrived[0] > 100


def answers_then_killed(domain: int, count: int, *service: str) -> int:
    client = start(domain, "killed", (count, 0.0, 1), *service)
    begin(client)
    answered = int(client.stdout.readline())
    client.kill()
    client.wait()
    return answered


def test_what_is_kept_for_a_killed_client_is_in_nobodys_way(
    make_node: Callable[[int], Any], ros_domain: int
) -> None:
    """DDS has room for 5 000 responses that some client has not received."""
    response = default_response(TYPE)
    server = make_node(ros_domain).serve("/kept", TYPE, lambda _, h: server.respond(h, response))
    assert answers_then_killed(ros_domain, 1, "/kept") == 1
    client = make_node(ros_domain).client("/kept", TYPE)
    wait_for(client.available, "discovery")
    answered: list[bytes] = []
    for sent in range(100, 5301, 100):
        for _ in range(100):
            client.call(response, answered.append)
        wait_for(lambda sent=sent: len(answered) == sent, "responses")
