"""A robot with two interfaces, in network namespaces of the test's own."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.proxy.gateway_pool import GatewayPool, ran
from tests.wire.namespaces import Namespaces, why_not
from tests.wire.wire_pool import wait_for

pytestmark = [
    pytest.mark.timeout(120),
    pytest.mark.skipif(bool(why_not()), reason=why_not() or "namespaces can be made"),
]
# One address of the replica, reached through either cable.
REPLICA = "10.79.9.9"
LIMIT_S = 90.0


class Net:
    """A robot and a replica with two cables between them."""

    def __init__(self, made: Namespaces) -> None:
        self.made = made
        self.robot, self.replica = made.add("r"), made.add("p")
        self.cables = []
        for number in (1, 2):
            near, far = made.join(
                self.robot, f"10.79.{number}.1", self.replica, f"10.79.{number}.2"
            )
            made.route(self.robot, REPLICA, f"10.79.{number}.2", near, metric=number)
            self.cables.append((near, far))
        made.address(self.replica, REPLICA)

    def stall(self, number: int) -> None:
        """Let nothing come back on a cable; nobody is told."""
        self.made.blackhole(self.replica, f"10.79.{number + 1}.1")

    def heal(self, number: int) -> None:
        self.made.restore(self.replica, f"10.79.{number + 1}.1")

    def remove(self, number: int) -> None:
        self.made.remove(self.robot, self.cables[number][0])


@pytest.fixture
def net() -> Iterator[Net]:
    made = Namespaces()
    try:
        yield Net(made)
    finally:
        made.close()


@pytest.mark.parametrize("policy", ["all", "prefer", "failover"])
@pytest.mark.parametrize("fault", ["stall", "remove"])
def test_an_uplink_that_goes_costs_no_request(tmp_path, net, policy, fault):
    """Requests are under way the whole time, first on one uplink, then on the other."""
    pool = GatewayPool(tmp_path, timeout_s=30.0, services=f", uplinks: {policy}")
    try:
        pool.replica(0, where=net.replica, host=REPLICA, delay_s=0.05)
        interfaces = ", ".join(near for near, _ in net.cables)
        robot = pool.robot("ada", where=net.robot, extra=f"uplinks: [{interfaces}]\n")
        wait_for(lambda: ups(robot) == ["up", "up"])
        robot.ask(20)
        robot.all_right()
        if fault == "stall":
            net.stall(0)
        else:
            net.remove(0)
        for _ in range(20):
            robot.ask(5, 1000)
        robot.all_right()
        wait_for(lambda: ups(robot)[0] != "up")
        robot.ask(20)
        robot.all_right()
        told = robot.tell()["report"]["services"]["/echo"]
        assert (told["silent"], told["late"]) == (0, 0)
        if fault == "stall":
            net.heal(0)
            wait_for(lambda: ups(robot) == ["up", "up"])
            net.stall(1)
            robot.ask(20)
            robot.all_right()
    finally:
        pool.close()


def test_copies_through_both_cables_are_run_once(tmp_path, net):
    """With `uplinks: all`, one cable held up, and one taken away: each request ran once."""
    pool = GatewayPool(tmp_path, timeout_s=60.0, services=", uplinks: all")
    server = pool.server_proxy(0, where=net.replica, host=REPLICA, delay_s=0.05)
    try:
        interfaces = ", ".join(near for near, _ in net.cables)
        robot = pool.robot("ada", where=net.robot, extra=f"uplinks: [{interfaces}]\n")
        wait_for(lambda: ups(robot) == ["up", "up"], LIMIT_S)
        sent = [net.made.sent_bytes(net.robot, near) for near, _ in net.cables]
        robot.ask(40, 1000)
        robot.all_right()
        carried = [
            net.made.sent_bytes(net.robot, near) - before
            for (near, _), before in zip(net.cables, sent, strict=True)
        ]
        assert min(carried) > 20 * 1000, carried  # copies on either cable
        net.stall(0)
        robot.ask(40, 1000)
        net.heal(0)  # what waited on that cable arrives now
        robot.all_right()
        wait_for(lambda: ups(robot) == ["up", "up"], LIMIT_S)
        robot.ask(40, 1000)
        net.remove(1)
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
