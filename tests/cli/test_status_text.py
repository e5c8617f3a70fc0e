"""What stands below the tables of `fogft status`, and who talks through whom, drawn."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest

from fogft.cli import output
from fogft.cli.lifecycle import services_at_fault
from fogft.cli.status_text import notes, rendered, topology, troubles
from fogft.model.replica import LinkReport, LinkState, ReplicaId
from fogft.pool.commands.status import Seen, current
from fogft.pool.manager.proxy_report import ProxyReport, TopicCounted
from fogft.pool.manager.status import ServiceStatus, TopicStatus
from tests.fakes.pools import REPLICA, STATUS, UID

SCAN = TopicStatus("/scan", "sensor_msgs/msg/LaserScan", "robot")
SETBOOL = "std_srvs/srv/SetBool"


def with_topic(ready: frozenset[str], counted: TopicCounted) -> Seen:
    link = LinkReport(ReplicaId(UID, 0, 1), LinkState.UP, ready)
    report = ProxyReport(1, 5.0, links=(link,), topics={"/scan": counted})
    status = replace(STATUS, topics=(SCAN,), observed_at=5.0)
    return current(status, report, manager_alive=True, proxy_alive=True, now=5.0)


def test_a_topic_is_shown_with_who_hears_it_and_what_became_of_its_messages():
    """And in --json."""
    seen = with_topic(frozenset({"/plan", "topic /scan"}), TopicCounted(120, 118, 2, 0, 10.0))
    shown = shown_lines(seen)
    at = next(i for i, line in enumerate(shown) if line.startswith("TOPIC"))
    assert shown[at + 1].split() == ["/scan", "robot", "0.1", "10", "Hz", "120", "118", "2"]
    assert troubles(seen.status) == []
    (told,) = seen.to_json()["topics"]
    assert told["heard_by"] == ["0.1"]
    assert (told["counters"]["passed"], told["counters"]["rate_hz"]) == (118, 10.0)


@pytest.mark.parametrize(
    ("ready", "trouble", "said"),
    [
        ({"/plan"}, "", "`/scan` has no subscriber with compatible QoS on a replica"),
        ({"/plan", "topic /scan"}, "it offers best effort", "it offers best effort"),
    ],
)
def test_a_topic_that_does_not_pass_is_named(ready, trouble, said):
    """It would just vanish."""
    seen = with_topic(frozenset(ready), TopicCounted(5, trouble=trouble))
    assert troubles(seen.status) == [said]
    assert f"note: {said}" in shown_lines(seen)


def test_a_topic_whose_type_differs_is_named_at_its_replica_alone():
    seen = with_topic(frozenset({"/plan"}), TopicCounted(5))
    replica = replace(REPLICA, differs=True, differing=("topic /scan",), detail="a field differs")
    assert troubles(replace(seen.status, replicas=(replica,))) == []


def test_more_replicas_than_wanted_are_not_a_part_of_them():
    """As while one stands in for another."""
    seen = Seen(replace(STATUS, ready=3, target=2), 0.0, manager_alive=True)
    assert "  3 ready, 2 wanted  " in shown_lines(seen)[0]


def test_a_client_that_gets_no_answers_is_told():
    service = replace(STATUS.services[0], counters={"trouble": "a client runs on another"})
    assert troubles(replace(STATUS, services=(service,))) == ["a client runs on another"]


def test_a_service_with_fewer_ready_replicas_than_its_quorum_does_not_answer():
    link = LinkReport(ReplicaId(UID, 0, 1), LinkState.UP, frozenset({"/plan"}))
    for quorum, answers in ((1, True), (2, False)):
        report = ProxyReport(1, 5.0, links=(link,), services={"/plan": {"quorum": quorum}})
        status = replace(STATUS, observed_at=5.0)
        seen = current(status, report, manager_alive=True, proxy_alive=True, now=5.0)
        assert seen.answers is answers
        assert ("its `quorum` is 2, and fewer" in str(notes(seen.status))) is not answers
        assert services_at_fault(seen.status) == ([] if answers else ["/plan"])


def test_only_services_whose_type_differs_are_named():
    """The others wait for the same replicas, and nothing is wrong with them."""
    differing = ("/odd", "topic /scan")
    replica = replace(REPLICA, differs=True, differing=differing, detail="`a/srv/B` differs")
    services = tuple(ServiceStatus(name, SETBOOL, 0) for name in ("/even", "/odd"))
    status = replace(STATUS, replicas=(replica,), services=services)
    assert services_at_fault(status) == ["/odd"]
    for other in (REPLICA, replace(REPLICA, differing=("topic /scan",))):
        assert services_at_fault(replace(status, replicas=(other,))) == ["/even", "/odd"]


def shown_lines(seen: Seen) -> list[str]:
    from io import StringIO

    from rich.console import Console

    out = Console(file=StringIO(), width=160)
    out.print(rendered(seen, width=160))
    return [line.rstrip() for line in out.file.getvalue().splitlines()]


def test_a_port_that_strangers_flood_is_told_of():
    flooded = replace(STATUS.replicas[0], strangers=9800)
    status = replace(STATUS, notes=(), replicas=(flooded, *STATUS.replicas[1:]))
    (line,) = [line.plain for line in notes(status)]
    assert line.startswith("note: replica 0.1 has refused 9 800 unauthenticated connections: ")


def test_the_lines_of_a_log_stand_below_the_note_that_they_explain():
    status = replace(STATUS, notes=("it was never ready\nno module `plan`", "over"), services=())
    assert [line.plain for line in notes(replace(status, excluded=()))] == [
        *("note: it was never ready", "  no module `plan`", "note: over"),
    ]


def test_a_pool_that_is_too_small_says_how_many_replicas_would_do():
    service = replace(STATUS.services[0], counters={"needed_replicas": 6})
    status = replace(STATUS, notes=(), excluded=(), services=(service,))
    assert [line.plain for line in notes(status)] == [
        f"note: `{service.name}`: load exceeds the capacity of its replicas; 6 would suffice"
    ]


@pytest.mark.parametrize(("count", "by"), [(0, "requests"), (1, "a request"), (7, "7 requests")])
def test_requests_that_crashed_a_service_are_told_with_its_type_and_when(count, by):
    """Those, too, that its fallback has answered, and that count as that."""
    at = time.mktime((2026, 11, 26, 17, 30, 5, 0, 0, -1))
    service = ServiceStatus("/s", SETBOOL, 1, counters={"poison": count, "poisoned_at": at})
    status = replace(STATUS, notes=(), excluded=(), services=(service,))
    assert [line.plain for line in notes(status)] == [
        f"note: `/s` ({SETBOOL}): crashed by {by}, not retried; "
        "most recently at 2026-11-26 17:30:05"
    ]


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
