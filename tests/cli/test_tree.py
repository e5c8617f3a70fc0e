"""Who talks through whom, drawn."""

from __future__ import annotations

from fogft.cli.tree_text import tree


def gateway(name, through=(), generations=(1,)):
    return {"name": name, "endpoint": f"{name}:7470", "through": list(through),
            "generations": list(generations)}  # fmt: skip


def test_a_pool_without_gateways_draws_nothing():
    assert tree({}, colour=False) == []


def test_robots_gateways_and_what_lies_behind():
    """This robot's links with their state; others' and deeper ones without: nobody here knows."""
    topology = {
        "robot": "ada",
        "gateways": [gateway("edge"), gateway("lab", ["edge"], [])],
        "robots": {"bob": []},
        "through": ["edge", "lab"],
        "links": [
            {"name": "edge", "generation": 1, "state": "suspect", "rtt_s": None, "detail": "x"},
            {"name": "edge", "generation": 2, "state": "up", "rtt_s": 0.0012, "detail": ""},
        ],
    }
    assert tree(topology, colour=False) == [
        "TOPOLOGY",
        "robot ada",
        "├─ gateway edge  edge:7470  up  1.20 ms",
        "│  └─ replicas",
        "└─ gateway lab  lab:7470  no certificate",
        "   └─ gateway edge  edge:7470",
        "      └─ replicas",
        "robot bob",
        "└─ replicas",
        "all other robots",
        "├─ gateway edge  edge:7470",
        "│  └─ replicas",
        "└─ gateway lab  lab:7470  no certificate",
        "   └─ gateway edge  edge:7470",
        "      └─ replicas",
    ]
