"""Gateways over loopback: real processes, real links, replicas that echo; no ROS, no root."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

from tests.bench import uplink
from tests.link.wire_pool import wait_for
from tests.needs import needs
from tests.proxy.gateway_pool import GatewayPool, Process

pytestmark = pytest.mark.timeout(120)


@pytest.fixture
def pool(tmp_path) -> Iterator[GatewayPool]:
    made = GatewayPool(tmp_path)
    yield made
    made.close()


def test_a_robot_behind_a_gateway_sends_each_request_once(pool):
    """Both replicas get some, the robot sends one copy and gets one response, its own."""
    pool.replica(0)
    pool.replica(1)
    edge = pool.gateway("edge")
    pool.lay_out({"edge": (edge.endpoint(), ())}, {"ada": ["edge"]})
    robot = pool.robot("ada")
    wait_for(robot.ready)
    wait_for(lambda: len([li for li in robot.tell()["report"]["links"] if li["ready"]]) == 2)
    robot.ask(100, 1000)
    robot.all_right()
    assert robot.sent() == 100
    wait_for(lambda: pool.ran() > 100)  # copies that lost early may be withdrawn
    report = robot.tell()["report"]
    assert [g["name"] for g in report["gateways"]] == ["edge"]
    assert {(li["slot"], li["through"]) for li in report["links"]} == {(0, "edge"), (1, "edge")}
    wait_for(lambda: edge.report()["forwarded"]["passed"] == 100)


def test_gateways_nest(pool):
    """Through two gateways, one behind the other: still one copy, and the tree is reported."""
    pool.replica(0)
    far = pool.gateway("far")
    near = pool.gateway("near")
    pool.lay_out(
        {"far": (far.endpoint(), ()), "near": (near.endpoint(), ["far"])}, {"ada": ["near"]}
    )
    robot = pool.robot("ada")
    # Until they have heard of the topology, gateways reach the replica themselves.
    wait_for(lambda: [li["through"] for li in robot.tell()["report"]["links"]] == ["near/far"])
    wait_for(robot.ready)
    robot.ask(50)
    robot.all_right()
    assert robot.sent() == 50
    assert pool.ran() == 50


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP], ids=["kill", "freeze"])
def test_one_of_two_gateways_dies_and_nothing_is_lost(pool, how):
    """Requests are under way the whole time; each gets its own answer, through the other one."""
    pool.replica(0, delay_s=0.02)
    pool.replica(1, delay_s=0.02)
    gateways = {name: pool.gateway(name) for name in ("one", "two")}
    pool.lay_out({n: (g.endpoint(), ()) for n, g in gateways.items()}, {"ada": ["one", "two"]})
    robot = pool.robot("ada")
    wait_for(lambda: robot.ready(2))
    for _ in range(10):
        robot.ask(5)

    def passed(gateway: Process) -> int:
        return int(gateway.report()["forwarded"]["passed"])

    wait_for(lambda: sum(map(passed, gateways.values())) >= 50)
    used = max(gateways.values(), key=passed)
    robot.ask(20)
    os.kill(used.process.pid, how)
    for _ in range(10):
        robot.ask(5)
    robot.all_right()
    used.process.kill()


def test_a_gateway_cut_off_from_its_replicas_hands_back_what_it_holds(pool):
    """Its only replica dies, another gateway's lives: what was in flight is answered there."""
    pool.replica(0, delay_s=30.0)
    one, two = pool.gateway("one"), pool.gateway("two")
    pool.lay_out({"one": (one.endpoint(), ())}, {"ada": ["one"]})
    robot = pool.robot("ada")
    wait_for(robot.ready)
    robot.ask(10)
    wait_for(lambda: pool.ran() == 10)
    pool.forget(0)
    pool.replica(1)
    pool.lay_out(
        {"one": (one.endpoint(), ()), "two": (two.endpoint(), ())}, {"ada": ["one", "two"]}
    )
    robot.all_right()


def test_membership_moves_a_robot_from_a_gateway_to_the_replicas_and_back(pool):
    """Who talks through whom changes under load, and nothing is lost by it."""
    pool.replica(0)
    edge = pool.gateway("edge")
    gateways = {"edge": (edge.endpoint(), ())}
    robot = pool.robot("ada")
    for through in (["edge"], [], ["edge"]):
        pool.lay_out(gateways, {"ada": through})
        wait_for(
            lambda through=through: (
                bool(robot.tell()["report"]["gateways"]) == bool(through) and robot.ready()
            )
        )
        robot.ask(20)
    robot.all_right()


def test_a_gateway_goes_on_under_a_new_certificate(pool):
    """Both generations are let in for a while; the robot finds whichever is shown."""
    pool.replica(0)
    edge = pool.gateway("edge")
    at = {"edge": (edge.endpoint(), ())}
    pool.lay_out(at, {"ada": ["edge"]}, generations=(1, 2))
    robot = pool.robot("ada")
    wait_for(robot.ready)
    robot.ask(10)
    edge.kill()
    next_ = pool.gateway("edge", listen=at["edge"][0], generation=2)
    robot.ask(10)
    robot.all_right()
    wait_for(lambda: next_.report().get("gateway") == "edge.2")


def test_only_a_gateways_certificate_will_do(pool):
    """A replica's certificate at a gateway's address is sent nothing."""
    pool.replica(0)
    pool.lay_out({"edge": (pool.endpoint(0), ())}, {"ada": ["edge"]})
    robot = pool.robot("ada")
    wait_for(lambda: "certificate" in str(robot.tell()["report"]["gateways"]))
    assert pool.ran() == 0
    assert not robot.ready()


@pytest.mark.parametrize("replicas", [pytest.param(1, marks=needs("night")), 4])
def test_the_uplink_carries_each_request_once(tmp_path, replicas):
    """At most 1.05 times the payload, whatever the number of replicas; probes are counted."""
    found = uplink.of_pool(tmp_path / "pool", replicas, 50, delay_s=0.5)
    assert found["through_a_gateway"] <= 1.05
    if replicas > 1:  # on a busy machine a loser may be stopped before all of it has left
        assert found["directly"] > 1.5


def test_an_uplink_that_is_not_there_costs_nothing(pool):
    """Over loopback: one interface exists and one does not, which is said."""
    pool.replica(0)
    pool.reach(0, f"localhost:{pool.endpoint(0).rpartition(':')[2]}")
    robot = pool.robot("ada", extra="uplinks: [nosuch0, lo]\n")
    wait_for(robot.ready)
    robot.ask(50)
    robot.all_right()
    (link,) = robot.tell()["report"]["links"]
    assert [u["state"] for u in link["uplinks"]] == ["connecting", "up"]
    assert "nosuch0" in link["uplinks"][0]["detail"]
