"""Whose executor is asked for a turn, and how often that was."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest

from fogft.errors import RosError
from fogft.ros.pacing.pacer import KEPT, NodeProbes

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
