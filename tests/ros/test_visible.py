"""The node that people see, looked at by an ordinary rclpy node in another context."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from fogft.errors import RosError
from fogft.ros.port import Level, Status
from fogft.ros.visible import SAME_LIMIT
from tests.ros.nodes.person import Person

pytestmark = pytest.mark.ros
STATUS = Status(Level.WARN, "fogft arm: pool", "1 of 2", "robot", {"replicas": "2"})
log = logging.getLogger("fogft.test")


@pytest.fixture
def person(ros_domain: int) -> Iterator[Person]:
    made = Person(ros_domain)
    yield made
    made.close()


@pytest.fixture(autouse=True)
def our_level() -> Iterator[None]:
    ours = logging.getLogger("fogft")
    before = ours.level
    ours.setLevel(logging.INFO)
    yield
    ours.setLevel(before)


def test_diagnostics_and_the_log_reach_whoever_looks(person, make_node, ros_domain, monkeypatch):
    """Each record once, with its own level, also from a thread that must not block."""
    visible = make_node(ros_domain).make_visible("fogft_arm", lambda _: "")
    person.watch_diagnostics()
    person.watch_log()

    def told() -> bool:  # discovery may come after the first ones
        visible.diagnose([STATUS])
        return STATUS.name in person.statuses

    person.wait(told, "the status")
    seen = person.statuses[STATUS.name]
    assert (seen.level, seen.message, seen.hardware_id) == (b"\x01", "1 of 2", "robot")
    assert [(v.key, v.value) for v in seen.values] == [("replicas", "2")]

    log.info("link_up replica=%s", "0.1")
    log.warning("link_lost")
    log.error("cannot go on")
    log.debug("of no interest")
    with monkeypatch.context() as apart:  # no text that ROS takes, nor what reports this test
        apart.setattr(logging.getLogger("fogft"), "propagate", False)
        log.warning("odd=%s", "caf\udce9")
    person.wait(lambda: any(m == "cannot go on" for _, _, m in person.log), "the log")
    ours = [(level, text) for level, name, text in person.log if name == "fogft_arm"]
    assert ours[:3] == [(20, "link_up replica=0.1"), (30, "link_lost"), (40, "cannot go on")]
    person.wait(lambda: any(m == "odd=caf?" for _, _, m in person.log), "what was no text")


def test_a_flood_of_one_kind_is_told_in_part(person, make_node, ros_domain):
    """As of requests that time out under overload; what else happens is told all the same."""
    make_node(ros_domain).make_visible("fogft_arm", lambda _: "")
    person.watch_log()
    person.wait(lambda: log.warning("found") or person.log, "the first record")

    def in_one_second(record: logging.LogRecord) -> bool:
        record.created = 1.0
        return True

    log.addFilter(in_one_second)
    try:
        for n in range(500):
            log.warning("timed_out request=%d", n)
        log.error("disk_full")
    finally:
        log.removeFilter(in_one_second)

    def told(what: str) -> list[str]:
        return [text for _, _, text in person.log if text.startswith(what)]

    def dropped() -> int:
        return sum(int(text.partition("count=")[2]) for text in told("log_records_dropped"))

    person.wait(lambda: dropped() >= 500 - SAME_LIMIT, "the number of the others")
    assert told("disk_full")
    assert len(told("timed_out")) == SAME_LIMIT


def test_parameters_are_judged_and_shown(person, make_node, ros_domain):
    """What is refused keeps its value; what comes and goes with a service does so at run time."""
    judged: list[dict[str, Any]] = []

    def judge(values) -> str:
        judged.append(dict(values))
        return "too short" if values.get("plan.timeout_s") == 1 else ""

    visible = make_node(ros_domain).make_visible("fogft_arm", judge)
    visible.show({"plan.timeout_s": 5.0, "plan.hedging": "all"})

    def values() -> list[Any]:
        return person.get("/fogft_arm", "plan.timeout_s", "plan.hedging", "see.hedging")

    person.wait(lambda: values() == [5.0, "all", None], "the parameters")
    assert judged == []
    result = person.set("/fogft_arm", plan__timeout_s=1)
    assert (result.successful, result.reason) == (False, "too short")
    assert person.set("/fogft_arm", plan__hedging="failover").successful
    assert values() == [5.0, "failover", None]
    assert judged == [{"plan.timeout_s": 1}, {"plan.hedging": "failover"}]
    visible.show({"plan.timeout_s": 7.0, "see.hedging": "all"})
    person.wait(lambda: values() == [7.0, None, "all"], "the changed parameters")
    assert len(judged) == 2


def test_diagnosing_once_its_thread_has_ended_ends_nobody(make_node, ros_domain):
    """Whatever ended it was logged; the client proxy goes on without."""
    visible = make_node(ros_domain).make_visible("fogft_arm", lambda _: "")
    visible.close()
    visible.diagnose([])


def test_the_level_can_be_set_by_ros(person, make_node, ros_domain):
    from rcl_interfaces.msg import LoggerLevel
    from rcl_interfaces.srv import SetLoggerLevels

    make_node(ros_domain).make_visible("fogft_arm", lambda _: "")
    wanted = LoggerLevel(name="fogft_arm", level=10)
    request = SetLoggerLevels.Request(levels=[wanted])
    person.ask(SetLoggerLevels, "/fogft_arm/set_logger_levels", request)
    ours = logging.getLogger("fogft")
    person.wait(lambda: ours.level == logging.DEBUG, "our level")


def test_without_diagnostic_msgs_one_warning_says_so(
    person, make_node, ros_domain, monkeypatch, caplog
):
    """All else works."""
    monkeypatch.setitem(sys.modules, "diagnostic_msgs.msg", None)
    visible = make_node(ros_domain).make_visible("fogft_arm", lambda _: "")
    [warning] = [r.getMessage() for r in caplog.records if "diagnostics_off" in r.getMessage()]
    assert "install" in warning
    visible.diagnose([STATUS])
    visible.show({"plan.timeout_s": 5.0})
    person.wait(lambda: person.get("/fogft_arm", "plan.timeout_s") == [5.0], "the parameter")


def test_a_bad_name_is_a_clear_error_and_the_node_lives_on(make_node, ros_domain):
    node = make_node(ros_domain)
    with pytest.raises(RosError, match="`not a name` cannot be created"):
        node.make_visible("not a name", lambda _: "")
    assert node.alive


def test_its_log_takes_nothing_when_it_is_closed(make_node, ros_domain):
    before = list(logging.getLogger("fogft").handlers)
    node = make_node(ros_domain)
    node.make_visible("fogft_arm", lambda _: "")
    assert logging.getLogger("fogft").handlers != before
    node.close()
    assert logging.getLogger("fogft").handlers == before
