"""Whose executor is asked for a turn, how often that was, and whose server has found a client."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from fogft.errors import RosError
from fogft.ros.entities import ReadinessProbe
from fogft.ros.pacing.pacer import KEPT, NodeProbes
from tests.fakes.proxy import Clock
from tests.ros.conftest import wait_for
from tests.ros.nodes.person import Person

CLIENT = b"c" * 16


class End:
    """A client of a node's parameter service."""

    def __init__(self) -> None:
        self.found = True
        self.closed = False
        self.asked: list[Callable[[bytes], None]] = []

    def available(self) -> bool:
        return self.found

    def call(self, payload: bytes, on_response: Callable[[bytes], None]) -> int:
        if self.closed:
            raise RosError("closed")
        self.asked.append(on_response)
        return len(self.asked)

    def close(self) -> None:
        self.closed = True


class Graph:
    def __init__(self) -> None:
        self.nodes = {CLIENT: "/left/arm"}
        self.ends: dict[str, Any] = {}

    def same_node_serves(self, what: str, service: str, client: bytes) -> str | None:
        assert (what, service) == ("get_parameter_types", "/detect")
        node = self.nodes.get(client)
        return node and f"{node}/{what}"  # empty where it has no parameters

    def client(self, name: str, type_name: str) -> End:
        self.ends[name] = End()
        return self.ends[name]


def probes_of(graph: Graph) -> NodeProbes:
    return NodeProbes(graph.client, graph.same_node_serves)


def test_a_node_with_parameters_answers_probes():
    graph = Graph()
    probes = probes_of(graph)
    assert probes.answers("/detect", CLIENT) is True
    answers = []
    for _ in range(3):
        probes.send(CLIENT, lambda: answers.append(1))
    (end,) = graph.ends.values()
    for on_response in end.asked:
        on_response(b"")
    assert len(answers) == 3
    successor, other = b"s" * 16, b"o" * 16
    graph.nodes[successor] = graph.nodes[CLIENT]
    assert probes.answers("/detect", successor)
    assert probes.same_node(CLIENT, successor)
    assert not probes.same_node(CLIENT, other)


def test_it_is_not_known_yet_whose_client_it_is_or_where_its_node_answers():
    graph = Graph()
    assert probes_of(graph).answers("/detect", b"?" * 16) is None
    graph.client = lambda name, type_name: _missing()
    assert probes_of(graph).answers("/detect", CLIENT) is None


def _missing() -> End:
    end = End()
    end.found = False
    return end


def test_a_node_without_parameters_answers_none():
    graph = Graph()
    graph.nodes = {CLIENT: ""}
    assert probes_of(graph).answers("/detect", CLIENT) is False
    assert not graph.ends


@pytest.mark.parametrize("known", [True, False])
def test_a_probe_that_cannot_be_sent_is_not_answered(known: bool):
    graph = Graph()
    probes = probes_of(graph)
    if known:
        assert probes.answers("/detect", CLIENT)
        graph.ends["/left/arm/get_parameter_types"].closed = True
    answered = threading.Event()
    probes.send(CLIENT, answered.set)
    assert not answered.is_set()


def test_of_many_nodes_the_first_are_let_go():
    graph = Graph()
    probes = probes_of(graph)
    for n in range(KEPT + 10):
        client = n.to_bytes(16, "big")
        graph.nodes[client] = f"/n{n}"
        assert probes.answers("/detect", client)
    assert sum(end.closed for end in graph.ends.values()) == 10


class Service:
    """A service, the parameter service of its node, and a probe."""

    def __init__(self, beside: str | None = "/node/get_parameter_types") -> None:
        self.clock = Clock()
        self.beside = beside
        self.ends: list[End] = []
        self.probe = ReadinessProbe(lambda: self.beside, self.client, self.clock)

    def client(self, name: str) -> Any:
        assert name == self.beside
        self.ends.append(End())
        return self.ends[-1]

    def passes(self, servers: int, after: float = 0.0) -> bool:
        self.clock.now += after
        return self.probe.passed(servers)


def test_a_service_passes_once_its_node_has_answered_and_each_new_server_anew():
    service = Service()
    assert [service.passes(n, 0.2) for n in (1, 1, 1, 1)] == [False] * 4
    (end,) = service.ends
    assert len(end.asked) == 2  # one answer may be lost
    end.asked[0](b"")
    assert service.passes(1)
    assert end.closed
    assert service.passes(1, 60.0)
    assert not service.passes(2, 0.1)  # another in place of one that is still listed
    service.ends[1].asked[0](b"")
    assert [service.passes(n, 0.1) for n in (2, 1, 0)] == [True] * 3
    assert not service.passes(1, 0.1)


@pytest.mark.parametrize(("beside", "at_once"), [("", True), (None, False), ("/n/x", False)])
def test_where_no_answer_can_be_expected_a_service_passes(beside, at_once):
    """Without parameters, not told of in discovery, or by an executor that does nothing else."""
    service = Service(beside)
    assert service.passes(1) is at_once
    assert service.passes(1, 4.0) is at_once
    assert service.passes(1, 2.0)
    assert all(end.closed for end in service.ends)


@pytest.mark.ros
def test_a_real_service_passes_once_its_node_is_spun(make_node, ros_domain):
    from std_srvs.srv import SetBool

    person = Person(ros_domain)
    try:
        person.node.create_service(SetBool, "/flag", lambda _, response: response)
        client = make_node(ros_domain).client("/flag", "std_srvs/srv/SetBool")
        wait_for(client.available, "discovery")
        for _ in range(10):
            assert not client.is_known()
            time.sleep(0.02)
        person.wait(client.is_known, "its answer")
        assert client.is_known()
    finally:
        person.close()
