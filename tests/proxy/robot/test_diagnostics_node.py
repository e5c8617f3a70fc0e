"""A real client proxy and replica, as the tools of ROS and Prometheus see them."""

from __future__ import annotations

import os
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from fogft.ros import environment
from tests.ports import free_ports
from tests.proxy.by_hand import Caller, Parts, Replica, Robot, wait_for
from tests.ros.nodes.person import Person

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]
environment.prepare(os.environ)


@pytest.fixture
def parts(tmp_path: Path, ros_domains: Callable[[], int]) -> Iterator[Parts]:
    made = Parts(tmp_path, ros_domains)
    yield made
    made.close()


def metrics(port: int) -> str:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=60) as response:
        return str(response.read().decode())


def value(said: str, name: str, **labels: str) -> float:
    """Return the sum of the samples of a name that have these labels, among others."""
    found = [
        sample.value
        for family in text_string_to_metric_families(said)
        for sample in family.samples
        if sample.name == name and labels.items() <= sample.labels.items()
    ]
    assert found, f"no {name} with {labels}"
    return sum(found)


def test_health_policies_log_and_metrics_are_seen_and_set(parts):
    """Of one pool: what its service counts is in `/diagnostics` and in the metrics, a policy is
    changed by `ros2 param set` while it runs, a bad one refused, and the log says so."""
    ports = free_ports(2)
    replica = Replica(parts, 0, 0.001, {}, extra=f"metrics: 127.0.0.1:{ports[0]}\n")
    robot = Robot(parts, "robot", (replica,), f"metrics: 127.0.0.1:{ports[1]}\n")
    caller, person = Caller(robot.domain), Person(robot.domain)
    try:
        person.watch_diagnostics()
        person.watch_log()
        caller.wait()
        caller.ask(10)
        assert caller.all_answered()

        def service() -> dict[str, str]:
            status = person.statuses.get("fogft p: service /plan")
            return {v.key: v.value for v in status.values} if status else {}

        person.wait(lambda: int(service().get("won by 0.1", 0)) >= 11, "the answers")
        assert float(service()["p99_ms"]) > 0
        assert service()["ready replicas"] == "1"
        levels = {name: status.level for name, status in person.statuses.items()}
        assert levels["fogft p: replica 0.1"] == b"\x00"

        assert person.get("/fogft_p", "plan.timeout_s", "plan.hedging") == [45.0, "auto"]
        refused = person.set("/fogft_p", plan__hedging="some")
        assert not refused.successful
        assert "`auto` or `all`" in refused.reason
        assert not person.set("/fogft_p", plan__ok_field="plan").successful  # no boolean
        assert person.set("/fogft_p", plan__hedging="failover").successful
        person.wait(
            lambda: any(level == 20 and "policy_set" in m for level, _, m in person.log), "the log"
        )
        wait_for(
            lambda: (
                "hedging_changed service=/plan to=failover"
                in (parts.folder / "robot.log").read_text()
            ),
            "the policy",
        )
        caller.ask(10)
        assert caller.all_answered()

        said = metrics(ports[1])
        answered = value(said, "fogft_outcomes_total", service="/plan", outcome="answered")
        assert answered >= 21
        assert value(said, "fogft_first_responses_total", service="/plan", slot="0") == answered
        assert value(said, "fogft_request_duration_seconds_count", service="/plan") == answered
        assert value(said, "fogft_link_up", slot="0") == 1
        said = metrics(ports[0])
        assert value(said, "fogft_requests_run_total") >= answered
        assert value(said, "fogft_service_ready", service="/plan") == 1
    finally:
        person.close()
        caller.close()
