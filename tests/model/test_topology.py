"""Who talks through whom: read back as written, never with a loop, neighbours as described."""

from __future__ import annotations

import json
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.errors import StateError
from fogft.model.credentials import Holder, Role
from fogft.model.membership import from_dict, to_dict
from fogft.model.plain import from_plain, to_plain
from fogft.model.replica import Membership
from fogft.model.topology import Gateway, RobotRoute, Topology, find_loop

UID = "0123456789abcdef"
NAMES = ["a", "b", "c", "d"]
through = st.lists(st.sampled_from(NAMES), unique=True, max_size=3).map(tuple)
graphs = st.fixed_dictionaries(dict.fromkeys(NAMES, through))


def made(graph: dict[str, tuple[str, ...]]) -> Topology:
    gateways = tuple(Gateway(name, "h:1", ups, (1,)) for name, ups in graph.items())
    return Topology(gateways, (RobotRoute("ada", ("a", "b")),), ("c",))


def reaches(graph: dict[str, tuple[str, ...]], start: str) -> set[str]:
    found: set[str] = set()
    stack = list(graph[start])
    while stack:
        name = stack.pop()
        if name not in found:
            found.add(name)
            stack += graph[name]
    return found


@given(graphs)
def test_a_loop_is_found_where_there_is_one(graph):
    """A loop is reported exactly where somebody reaches itself, and each step of it is real."""
    loop = find_loop(graph)
    assert bool(loop) == any(name in reaches(graph, name) for name in graph)
    if loop:
        assert loop[0] == loop[-1]
        assert all(b in graph[a] for a, b in pairwise(loop))


@given(graphs)
def test_what_is_written_is_read_unless_it_loops(graph):
    """A topology survives JSON; one with a loop is refused by every reader."""
    topology = made(graph)
    raw = json.loads(json.dumps(to_dict(Membership("p", UID, 1, 1, topology=topology))))
    if find_loop(graph):
        with pytest.raises(StateError, match="loop"):
            from_dict(raw)
    else:
        assert from_dict(raw).topology == topology


@given(
    st.recursive(
        st.none() | st.integers() | st.text(),
        lambda s: (
            st.lists(s)
            | st.dictionaries(
                st.sampled_from(
                    ["gateways", "routes", "through", "name", "endpoint", "generations"]
                ),
                s,
            )
        ),
    )
)
def test_anything_else_is_an_error(raw):
    """Whatever JSON comes, a reader returns a topology or raises `ValueError`."""
    try:
        read = from_plain(Topology, raw)
    except ValueError:
        return
    assert from_plain(Topology, json.loads(json.dumps(to_plain(read)))) == read


def test_neighbours():
    """Robots by name, else the default; gateways by their own `through`; strangers the replicas."""
    topology = made({"a": ("b",), "b": (), "c": (), "d": ()})

    def of(role: Role, name: str) -> list[str]:
        return [g.name for g in topology.neighbours(Holder(role, name, 1, UID))]

    assert of(Role.ROBOT, "ada") == ["a", "b"]
    assert of(Role.ROBOT, "bob") == ["c"]
    assert of(Role.GATEWAY, "a") == ["b"]
    assert of(Role.GATEWAY, "b") == []
    assert of(Role.GATEWAY, "unknown") == []
