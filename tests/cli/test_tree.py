"""Who talks through whom, drawn."""

from __future__ import annotations

from fogft.cli import output
from fogft.cli.status_text import topology


def gateway(name, through=(), generations=(1,)):
    return {"name": name, "endpoint": f"{name}:7470", "through": list(through),
            "generations": list(generations)}  # fmt: skip


def test_a_pool_without_gateways_draws_nothing():
    assert topology({}) == []


def test_robots_gateways_and_what_lies_behind(capsys):
    """This robot's links with their state; others' and deeper ones without: nobody here knows."""
    seen = {
        "robot": "ada",
        "gateways": [gateway("edge"), gateway("lab", ["edge"], [])],
        "robots": {"bob": []},
        "through": ["edge", "lab"],
        "links": [
            {"name": "edge", "generation": 1, "state": "suspect", "rtt_s": None, "detail": "x"},
            {"name": "edge", "generation": 2, "state": "up", "rtt_s": 0.0012, "detail": ""},
        ],
    }
    output.show(*topology(seen))
    assert capsys.readouterr().out.splitlines() == [
        "TOPOLOGY",
        "robot ada",
        "├── gateway edge  edge:7470  up  1.20 ms",
        "│   └── replicas",
        "└── gateway lab  lab:7470  no certificate",
        "    └── gateway edge  edge:7470",
        "        └── replicas",
        "robot bob",
        "└── replicas",
        "all other robots",
        "├── gateway edge  edge:7470",
        "│   └── replicas",
        "└── gateway lab  lab:7470  no certificate",
        "    └── gateway edge  edge:7470",
        "        └── replicas",
    ]
