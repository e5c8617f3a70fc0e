"""One suite for every `RosNode`: in memory, over rcl, over Zenoh."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest

from fogft.errors import RosError
from fogft.ros import environment
from tests.fakes.ros import MemoryDomain
from tests.fakes.waiting import wait_for
from tests.rmw_zenoh.rmw_router import Router

SET_BOOL = "std_srvs/srv/SetBool"
TRUE = b"\x00\x01\x00\x00\x01"  # SetBool's request, little-endian CDR
LIMIT_S = 30.0


@dataclass
class World:
    """A domain under test: how nodes are made in it, and how time passes in it."""

    new_node: Callable[[], Any]
    pump: Callable[[], Any] = lambda: None  # where time passes by itself
    pause_s: float = 0.005
    loads_types: bool = True
    nodes: list[Any] = field(default_factory=list)

    def node(self) -> Any:
        self.nodes.append(self.new_node())
        return self.nodes[-1]

    def wait_for(self, condition: Callable[[], Any], what: str) -> None:
        def holds() -> Any:
            self.pump()
            return condition()

        wait_for(holds, LIMIT_S, what, pause_s=self.pause_s)

    def pair(self, respond: Callable[[bytes], bytes | None], name: str = "/flag") -> Any:
        """Serve on one node and return a client on another that has found it."""
        server_node, client_node = self.node(), self.node()
        made: dict[str, Any] = {}

        def on_request(payload: bytes, handle: Any) -> None:
            response = respond(payload)
            if response is not None:
                made["server"].respond(handle, response)

        made["server"] = server_node.serve(name, SET_BOOL, on_request)
        client = client_node.client(name, SET_BOOL)
        self.wait_for(client.available, "discovery")
        return made["server"], client


def _memory() -> World:
    domain = MemoryDomain(types=[SET_BOOL])
    return World(domain.node, domain.pump, 0.0)


def _rclpy(domain: int) -> World:
    environment.prepare(os.environ)
    from fogft.ros.node import SerialisedNode

    return World(lambda: SerialisedNode("contract", domain))


def _zenoh(router: Router) -> World:
    from fogft.rmw_zenoh.node import RmwZenohNode

    hashes = {SET_BOOL: ["RIHS01_" + "ab" * 32]}
    return World(
        lambda: RmwZenohNode(
            "contract", 7, hashes_of=lambda t: hashes.get(t, []), environ=router.environ
        ),
        loads_types=False,
    )


@pytest.fixture(
    params=[
        "memory",
        "zenoh",
        pytest.param("rcl", marks=pytest.mark.ros),
    ]
)
def world(request: pytest.FixtureRequest) -> Iterator[World]:
    if request.param == "memory":
        made = _memory()
    elif request.param == "zenoh":
        made = _zenoh(request.getfixturevalue("rmw_router"))
    else:
        made = _rclpy(request.getfixturevalue("ros_domain"))
    yield made
    for node in made.nodes:
        node.close()


def _response(number: int) -> bytes:
    """SetBool's response: success, and the number as its message."""
    text = str(number).encode() + b"\0"
    return b"\x00\x01\x00\x00" + b"\x01\0\0\0" + len(text).to_bytes(4, "little") + text


def _number(response: bytes) -> int:
    """Read the number back. The padding before the text is whatever lay in memory."""
    assert response[4] == 1
    return int(response[12:].split(b"\0")[0])


def test_a_request_gets_its_response(world: World) -> None:
    """What the service answers is what the caller gets, to the byte that counts."""
    seen: list[bytes] = []
    _, client = world.pair(lambda payload: (seen.append(payload), _response(7))[1])
    answers: list[bytes] = []
    client.call(TRUE, answers.append)
    world.wait_for(lambda: answers, "the response")
    assert seen[0][4] == 1
    assert _number(answers[0]) == 7


def test_a_hundred_requests_in_flight_lose_none(world: World) -> None:
    """Each of a burst of requests gets one response, and its own."""
    held: list[tuple[Any, int]] = []
    server_node, client_node = world.node(), world.node()
    server = server_node.serve("/burst", SET_BOOL, lambda p, h: held.append((h, p[4])))
    client = client_node.client("/burst", SET_BOOL)
    world.wait_for(client.available, "discovery")
    answers: dict[int, list[bytes]] = {number: [] for number in range(100)}
    tickets = [client.call(TRUE, answers[number].append) for number in answers]
    world.wait_for(lambda: len(held) == 100, "all requests")
    for number, (handle, _) in enumerate(held):
        server.respond(handle, _response(number))
    world.wait_for(lambda: all(answers.values()), "all responses")
    assert len(set(tickets)) == 100
    assert [_number(answer) for (answer,) in answers.values()] == list(range(100))


def test_responses_may_come_in_any_order(world: World) -> None:
    """A response reaches the caller of its own request, whatever the order."""
    held: list[tuple[Any, int]] = []
    server_node, client_node = world.node(), world.node()
    server = server_node.serve("/order", SET_BOOL, lambda p, h: held.append((h, p[4])))
    client = client_node.client("/order", SET_BOOL)
    world.wait_for(client.available, "discovery")
    order: list[str] = []
    client.call(TRUE, lambda _: order.append("true"))
    client.call(TRUE[:4] + b"\0", lambda _: order.append("false"))
    world.wait_for(lambda: len(held) == 2, "both requests")
    for handle, flag in sorted(held, key=lambda item: item[1]):
        server.respond(handle, _response(flag))
    world.wait_for(lambda: len(order) == 2, "both responses")
    assert order == ["false", "true"]


def test_a_forgotten_request_hears_nothing(world: World) -> None:
    """After `forget`, a response is dropped, and the next request is served as ever."""
    held: list[Any] = []
    server_node, client_node = world.node(), world.node()
    server = server_node.serve("/forget", SET_BOOL, lambda _, handle: held.append(handle))
    client = client_node.client("/forget", SET_BOOL)
    world.wait_for(client.available, "discovery")
    dropped: list[bytes] = []
    answers: list[bytes] = []
    ticket = client.call(TRUE, dropped.append)
    world.wait_for(lambda: held, "the first request")
    client.forget(ticket)
    client.forget(12345)
    client.call(TRUE, answers.append)
    world.wait_for(lambda: len(held) == 2, "both requests")
    for handle in held:
        server.respond(handle, _response(1))
    world.wait_for(lambda: answers, "the second response")
    assert dropped == []


def test_a_second_response_is_dropped(world: World) -> None:
    """The caller hears the first response only."""
    answers: list[bytes] = []
    server_node, client_node = world.node(), world.node()
    made: dict[str, Any] = {}

    def twice(_: bytes, handle: Any) -> None:
        made["server"].respond(handle, _response(1))
        made["server"].respond(handle, _response(2))

    made["server"] = server_node.serve("/twice", SET_BOOL, twice)
    client = client_node.client("/twice", SET_BOOL)
    world.wait_for(client.available, "discovery")
    client.call(TRUE, answers.append)
    fence: list[bytes] = []
    client.call(TRUE, fence.append)
    world.wait_for(lambda: fence, "the fence, sent after both")
    assert list(map(_number, answers)) == [1]


def test_malformed_requests_are_refused_and_nothing_is_sent(world: World) -> None:
    """Bytes that are no message raise; the service never sees an empty request instead."""
    seen: list[bytes] = []
    _, client = world.pair(lambda payload: (seen.append(payload), _response(1))[1])
    for bad in (b"", b"\x00", b"\x00\x01"):
        with pytest.raises(RosError, match="not a serialised"):
            client.call(bad, lambda _: None)
    answers: list[bytes] = []
    client.call(TRUE, answers.append)
    world.wait_for(lambda: answers, "the good request after the bad ones")
    assert len(seen) == 1


def test_a_malformed_response_is_refused_and_nothing_is_sent(world: World) -> None:
    """The one who responds learns of it, and may still send a good response."""
    errors: list[RosError] = []
    server_node, client_node = world.node(), world.node()
    made: dict[str, Any] = {}

    def bad_then_good(_: bytes, handle: Any) -> None:
        try:
            made["server"].respond(handle, b"\x00\x01")
        except RosError as error:
            errors.append(error)
        made["server"].respond(handle, _response(3))

    made["server"] = server_node.serve("/bad", SET_BOOL, bad_then_good)
    client = client_node.client("/bad", SET_BOOL)
    world.wait_for(client.available, "discovery")
    answers: list[bytes] = []
    client.call(TRUE, answers.append)
    world.wait_for(lambda: answers, "the good response")
    assert len(errors) == 1
    assert _number(answers[0]) == 3


def test_available_follows_the_service(world: World) -> None:
    """Not there, there, and gone again."""
    server_node, client_node = world.node(), world.node()
    client = client_node.client("/comes", SET_BOOL)
    assert not client.available()
    server = server_node.serve("/comes", SET_BOOL, lambda *_: None)
    world.wait_for(client.available, "the service to be found")
    world.wait_for(client.is_known, "the service to find its client")
    server.close()
    world.wait_for(lambda: not client.available(), "the service to be gone")


def test_a_service_can_be_offered_again(world: World) -> None:
    """Closing one service leaves the node able to serve, the same name included."""
    server, client = world.pair(lambda _: _response(1))
    server.close()
    world.wait_for(lambda: not client.available(), "the service to be gone")
    made: dict[str, Any] = {}
    made["server"] = world.nodes[0].serve(
        "/flag", SET_BOOL, lambda _, handle: made["server"].respond(handle, _response(2))
    )
    world.wait_for(client.available, "the service to be found again")
    answers: list[bytes] = []
    client.call(TRUE, answers.append)
    world.wait_for(lambda: answers, "the response")
    assert _number(answers[0]) == 2


def test_closing_is_repeatable_and_final(world: World) -> None:
    """What is closed stays closed, says so, and does not mind being closed again."""
    server, client = world.pair(lambda _: _response(1))
    handle = bytes(24)
    for closing in (server, client, *world.nodes):
        closing.close()
        closing.close()
    assert not client.available()
    server.respond(handle, _response(1))
    with pytest.raises(RosError, match="closed"):
        client.call(TRUE, lambda _: None)
    with pytest.raises(RosError, match="closed"):
        world.nodes[0].serve("/late", SET_BOOL, lambda *_: None)
    with pytest.raises(RosError, match="closed"):
        world.nodes[1].client("/late", SET_BOOL)


def test_an_unknown_type_is_an_error(world: World) -> None:
    """A type that cannot be loaded is refused on both sides, and the node lives on."""
    node = world.node()
    with pytest.raises(RosError, match="no_such_msgs"):
        node.serve("/x", "no_such_msgs/srv/Nothing", lambda *_: None)
    if world.loads_types:
        with pytest.raises(RosError, match="no_such_msgs"):
            node.client("/x", "no_such_msgs/srv/Nothing")
    node.serve("/x", SET_BOOL, lambda *_: None)


def test_calls_and_responses_from_many_threads(world: World) -> None:
    """Four threads that call and four that respond lose and confuse nothing."""
    requests: list[Any] = []
    server_node, client_node = world.node(), world.node()
    server = server_node.serve("/many", SET_BOOL, lambda _, handle: requests.append(handle))
    client = client_node.client("/many", SET_BOOL)
    world.wait_for(client.available, "discovery")
    answers: list[bytes] = []

    def call() -> None:
        for _ in range(50):
            client.call(TRUE, answers.append)

    def respond(part: int) -> None:
        for handle in requests[part::4]:
            server.respond(handle, _response(part))

    _together([call] * 4)
    world.wait_for(lambda: len(requests) == 200, "all requests")
    _together([lambda part=part: respond(part) for part in range(4)])  # type: ignore[misc]
    world.wait_for(lambda: len(answers) == 200, "all responses")
    assert sorted(map(_number, answers)) == [0] * 50 + [1] * 50 + [2] * 50 + [3] * 50


def _together(work: list[Callable[[], None]]) -> None:
    threads = [threading.Thread(target=each) for each in work]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LIMIT_S)
