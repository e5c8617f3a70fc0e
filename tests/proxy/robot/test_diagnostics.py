"""What `/diagnostics` says of a pool, from reports of the client proxy."""

from __future__ import annotations

from typing import Any

import pytest

from fogft.proxy.robot.diagnostics import UNMANAGED_AFTER_S, WINDOW_S, Diagnosis
from fogft.ros.port import Level


def link(slot: int, **more: Any) -> dict[str, Any]:
    usual = {
        "slot": slot, "generation": 1, "state": "up", "ready": ["/plan"], "draining": False,
        "at_risk": False, "disagrees": False, "silent_for_s": 0.0, "rtt_s": 0.0123,
        "in_flight": 0, "won": 5, "restarts": 0, "reopened": 0, "detail": "",
    }  # fmt: skip
    return {**usual, **more}


def report(*links: dict[str, Any], uplink: bool = False, **counts: Any) -> dict[str, Any]:
    usual = {
        "received": 9, "sent": 18, "answered": 9, "fallback": 0, "empty": 0, "silent": 0,
        "turned_away": 0, "late": 3, "won": {"0.1": 5, "1.1": 4}, "refused": {"crashed": 2},
        "p50_s": 0.021, "p99_s": None, "pending": 0,
    }  # fmt: skip
    services = {"/plan": {**usual, **counts}}
    return {"links": list(links), "services": services, "uplink_suspected": uplink}


def look(diagnosis: Diagnosis, told: dict[str, Any], now: float = 0.0) -> dict[str, Any]:
    return {s.name.removeprefix("fogft arm: "): s for s in diagnosis.of(told, now)}


def levels(told: dict[str, Any]) -> dict[str, Level]:
    return {name: s.level for name, s in look(Diagnosis("arm", "r"), told).items()}


def test_a_whole_pool_is_ok_and_says_who_answers_and_how_fast():
    said = look(Diagnosis("arm", "r"), report(link(0), link(1)))
    assert {s.level for s in said.values()} == {Level.OK}
    assert list(said) == ["pool", "service /plan", "replica 0.1", "replica 1.1"]
    values = said["service /plan"].values
    assert (values["won by 0.1"], values["won by 1.1"]) == ("5", "4")
    assert (values["p50_ms"], values["refused: crashed"]) == ("21", "2")
    assert "p99_ms" not in values  # unknown is not zero
    assert said["replica 0.1"].values["rtt_ms"] == "12.3"
    assert (said["pool"].hardware_id, said["replica 1.1"].hardware_id) == ("r", "1.1")


@pytest.mark.parametrize(
    ("told", "worst", "pool"),
    [
        (report(link(0), link(1, state="suspect", ready=[])), "replica 1.1", Level.WARN),
        (report(link(0, state="connecting", ready=[])), "service /plan", Level.ERROR),
        (report(), "service /plan", Level.ERROR),
        (report(link(0), link(1), uplink=True), "pool", Level.ERROR),
        (report(link(0), link(1), quorum=3), "service /plan", Level.ERROR),
    ],
)
def test_what_is_down_is_an_error_and_the_pool_is_as_bad_as_its_services(told, worst, pool):
    said = levels(told)
    assert said[worst] is Level.ERROR
    assert said["pool"] is pool


@pytest.mark.parametrize(
    "state",
    [
        *({"draining": True}, {"disagrees": True}, {"ready": []}, {"state": "connecting"}),
        {"hanging": ["/plan"], "detail": "`/plan` has requests and has answered none for 2 s"},
        {"detail": "uplink `wlan0`: there is no network interface `wlan0` here"},
    ],
)
def test_a_replica_that_is_not_all_right_is_a_warning(state):
    said = look(Diagnosis("arm", "r"), report(link(0), link(1, **state)))["replica 1.1"]
    assert said.level is Level.WARN
    assert said.message == state.get("detail", said.message)


@pytest.mark.parametrize("outcome", ["silent", "empty", "turned_away", "fallback", "poison"])
def test_a_request_without_a_replicas_answer_is_a_warning_for_a_while(outcome):
    diagnosis = Diagnosis("arm", "r")
    assert look(diagnosis, report(link(0)))["service /plan"].level is Level.OK
    for now, level in ((1.0, Level.WARN), (WINDOW_S, Level.WARN), (WINDOW_S + 2, Level.OK)):
        said = look(diagnosis, report(link(0), **{outcome: 2}), now)["service /plan"]
        assert said.level is level, now
        assert ("2 " in said.message) is (level is Level.WARN)


def test_a_topic_is_as_good_as_the_replicas_that_pass_it():
    passing = link(0, ready=["/plan", "topic /map"])
    told = {**report(passing, link(1)), "topics": {"/map": {"messages": 7, "passed": 0}}}
    said = look(Diagnosis("arm", "r"), told)["topic /map"]
    assert (said.level, said.values["messages"]) == (Level.WARN, "7")
    told["links"] = [link(0)]
    assert levels(told)["topic /map"] is Level.ERROR
    broken = {**told, "topics": {"/map": {"trouble": "no such type"}}}
    assert look(Diagnosis("arm", "r"), broken)["topic /map"].message == "no such type"


def test_a_request_that_crashed_a_service_is_told_with_its_type_and_when():
    values = look(Diagnosis("arm", "r"), report(link(0), type="a/srv/B"))["service /plan"].values
    assert (values["type"], "last poison" in values) == ("a/srv/B", False)
    killed = report(link(0), type="a/srv/B", poison=2, poisoned_at=1.7e9)
    values = look(Diagnosis("arm", "r"), killed)["service /plan"].values
    assert (values["poison"], values["last poison"]) == ("2", "2023-11-14T22:13:20Z")


def test_what_was_before_the_first_look_is_no_news():
    """A proxy that is diagnosed from its start has seen it all; one that began later has not."""
    assert levels(report(link(0), silent=7))["service /plan"] is Level.OK


def test_counters_that_begin_anew_are_no_trouble():
    diagnosis = Diagnosis("arm", "r")
    look(diagnosis, report(link(0), silent=7))
    assert look(diagnosis, report(link(0), silent=0), 1.0)["service /plan"].level is Level.OK


@pytest.mark.parametrize("managed", [True, False])
def test_the_time_left_without_a_manager_is_told_and_warned_of_where_there_is_none(managed: bool):
    """A manager signs a lease every minute; its replicas' leases end at different times."""
    ages = (5.0, 300.0) if managed else (UNMANAGED_AFTER_S, 300.0)
    links = [link(n, lease_age_s=age_s, lease_left_s=7200.0 - n) for n, age_s in enumerate(ages)]
    told = look(Diagnosis("arm", "r"), report(*links))["pool"]
    assert told.values["replicas end without a manager in_s"] == "7199"
    assert told.level is (Level.OK if managed else Level.WARN)
    assert ("no manager is running, and replicas shut down in 2.0 h" in told.message) is not managed


@pytest.mark.parametrize(
    ("left_s", "level", "said"),
    [
        (None, Level.OK, ""),
        (7200.0, Level.OK, ""),
        (600.0, Level.WARN, "the cloud's credentials expire in 10 min"),
        (-5.0, Level.WARN, "the cloud's credentials have expired"),
    ],
)
def test_credentials_of_the_cloud_are_counted_down(left_s: float | None, level: Level, said: str):
    told = look(Diagnosis("arm", "r"), {**report(link(0)), "credentials_left_s": left_s})["pool"]
    assert told.level is level
    assert said in told.message
    assert told.values.get("credentials end in_s") == (None if left_s is None else f"{left_s:g}")


@pytest.mark.parametrize(("days", "level"), [(None, Level.OK), (31, Level.OK), (29, Level.WARN)])
def test_the_last_month_of_its_certificate_is_counted_down(days: int | None, level: Level):
    left_s = None if days is None else days * 86_400.0
    told = look(Diagnosis("arm", "r"), {**report(link(0)), "certificate_left_s": left_s})["pool"]
    assert told.level is level
    assert ("certificate expires in 29.0 days" in told.message) == (days == 29)
