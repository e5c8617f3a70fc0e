"""A robot with two interfaces, in network namespaces of the test's own."""

from __future__ import annotations

import pytest

from tests.link.namespaces import Namespaces
from tests.link.wire_pool import wait_for
from tests.proxy.gateway_pool import GatewayPool, ran

pytestmark = pytest.mark.timeout(120)
# One address of the replica, reached through either cable.
REPLICA = "10.79.9.9"
LIMIT_S = 90.0


class TwoCables:
    """A robot and a replica with two cables between them."""

    def __init__(self, net: Namespaces) -> None:
        self.net = net
        self.robot, self.replica = net.add("r"), net.add("p")
        self.cables = []
        for number in (1, 2):
            near, far = net.join(self.robot, f"10.79.{number}.1", self.replica, f"10.79.{number}.2")
            net.route(self.robot, REPLICA, f"10.79.{number}.2", near, metric=number)
            self.cables.append((near, far))
        net.address(self.replica, REPLICA)

    def stall(self, number: int) -> None:
        """Let nothing come back on a cable; nobody is told."""
        self.net.blackhole(self.replica, f"10.79.{number + 1}.1")

    def heal(self, number: int) -> None:
        self.net.restore(self.replica, f"10.79.{number + 1}.1")

    def remove(self, number: int) -> None:
        self.net.remove(self.robot, self.cables[number][0])


@pytest.fixture
def two(net: Namespaces) -> TwoCables:
    return TwoCables(net)


@pytest.mark.parametrize("policy", ["all", "prefer", "failover"])
@pytest.mark.parametrize("fault", ["stall", "remove"])
def test_an_uplink_that_goes_costs_no_request(tmp_path, two, policy, fault):
    """Requests are under way the whole time, first on one uplink, then on the other."""
    pool = GatewayPool(tmp_path, timeout_s=30.0, services=f", uplink_policy: {policy}")
    try:
        pool.replica(0, where=two.replica, host=REPLICA, delay_s=0.05)
        interfaces = ", ".join(near for near, _ in two.cables)
        robot = pool.robot("ada", where=two.robot, extra=f"uplinks: [{interfaces}]\n")
        wait_for(lambda: ups(robot) == ["up", "up"])
        robot.ask(20)
        robot.all_right()
        if fault == "stall":
            two.stall(0)
        else:
            two.remove(0)
        for _ in range(20):
            robot.ask(5, 1000)
        robot.all_right()
        wait_for(lambda: ups(robot)[0] != "up")
        assert f"uplink `{two.cables[0][0]}`: " in robot.tell()["report"]["links"][0]["detail"]
        robot.ask(20)
        robot.all_right()
        told = robot.tell()["report"]["services"]["/echo"]
        assert (told["silent"], told["late"]) == (0, 0)
        if fault == "stall":
            two.heal(0)
            wait_for(lambda: ups(robot) == ["up", "up"])
            two.stall(1)
            robot.ask(20)
            robot.all_right()
    finally:
        pool.close()


def test_copies_through_both_cables_are_run_once(tmp_path, two):
    """With `uplink_policy: all`, one cable held up, and one taken away: each request ran once."""
    pool = GatewayPool(tmp_path, timeout_s=60.0, services=", uplink_policy: all")
    server = pool.server_proxy(0, where=two.replica, host=REPLICA, delay_s=0.05)
    try:
        interfaces = ", ".join(near for near, _ in two.cables)
        robot = pool.robot("ada", where=two.robot, extra=f"uplinks: [{interfaces}]\n")
        wait_for(lambda: ups(robot) == ["up", "up"], LIMIT_S)
        sent = [two.net.sent_bytes(two.robot, near) for near, _ in two.cables]
        robot.ask(40, 1000)
        robot.all_right()
        carried = [
            two.net.sent_bytes(two.robot, near) - before
            for (near, _), before in zip(two.cables, sent, strict=True)
        ]
        assert min(carried) > 20 * 1000, carried  # copies on either cable
        two.stall(0)
        robot.ask(40, 1000)
        two.heal(0)  # what waited on that cable arrives now
        robot.all_right()
        wait_for(lambda: ups(robot) == ["up", "up"], LIMIT_S)
        robot.ask(40, 1000)
        two.remove(1)
        robot.all_right()
        (counts,) = ran(tmp_path).values()
        assert sorted(counts.values()) == [1] * 120
    finally:
        pool.close()
        server.kill()
        server.wait()


def ups(robot) -> list[str]:
    links = robot.tell()["report"]["links"]
    return [uplink["state"] for link in links for uplink in link["uplinks"]]
