"""Gateways on real networks of the test's own: what an uplink carries, black holes.

Each has its counterpart over loopback (`test_gateway`), which runs without root.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator

import pytest

from tests.link.wire_pool import wait_for
from tests.needs import needs
from tests.proxy.gateway_pool import GatewayPool

pytestmark = pytest.mark.timeout(120)
PAYLOAD_BYTES = 100_000


@pytest.fixture
def pool(tmp_path, net) -> Iterator[GatewayPool]:
    made = GatewayPool(tmp_path, timeout_s=60.0)
    yield made
    made.close()


@pytest.mark.parametrize("replicas", [pytest.param(1, marks=needs("night")), 4])
def test_a_thin_uplink_carries_each_request_once(net, pool, replicas, record_property):
    """Packets of 1500 bytes, their headers and probes included, against the payload.

    The median of five rounds: on a busy machine TCP sends a packet twice that was only late.
    """
    robot_at, cloud = net.add("r"), net.add("c")
    near, _ = net.join(robot_at, "10.78.1.1", cloud, "10.78.1.2")
    net.by_packets(robot_at, near)
    for slot in range(replicas):
        pool.replica(slot, where=cloud)
    pool.gateway("edge", where=cloud, listen="10.78.1.2:7470").endpoint()
    pool.lay_out({"edge": ("10.78.1.2:7470", ())}, {"ada": ["edge"]})
    robot = pool.robot("ada", where=robot_at)
    wait_for(robot.ready)
    wait_for(lambda: sum(bool(li["ready"]) for li in robot.tell()["report"]["links"]) == replicas)
    ratios = []
    for _ in range(5):
        before = net.sent_bytes(robot_at, near)
        robot.ask(4, PAYLOAD_BYTES)
        robot.all_right()
        ratios.append((net.sent_bytes(robot_at, near) - before) / (4 * PAYLOAD_BYTES))
    ratio = statistics.median(ratios)
    record_property("packets_per_payload", ratio)
    assert robot.sent() == 20
    assert ratio <= 1.05, ratios


def test_a_blackholed_gateway_costs_no_request(net, pool):
    """Nothing gets through to the one in use, and nobody is told; the other one answers."""
    robot_at, one_at, two_at = net.add("r"), net.add("a"), net.add("b")
    net.join(robot_at, "10.78.1.1", one_at, "10.78.1.2")
    net.join(robot_at, "10.78.2.1", two_at, "10.78.2.2")
    net.join(one_at, "10.78.3.1", two_at, "10.78.3.2")
    pool.replica(0, where=two_at, host="10.78.3.2")
    at = {"one": "10.78.1.2", "two": "10.78.2.2"}
    pool.gateway("one", where=one_at, listen=f"{at['one']}:7470").endpoint()
    pool.gateway("two", where=two_at, listen=f"{at['two']}:7470").endpoint()
    pool.lay_out({n: (f"{a}:7470", ()) for n, a in at.items()}, {"ada": ["one", "two"]})
    robot = pool.robot("ada", where=robot_at)
    wait_for(lambda: robot.ready(2))
    robot.ask(20)
    robot.all_right()
    for address in at.values():
        net.blackhole(robot_at, address)
        for _ in range(20):
            robot.ask(5)
        robot.all_right()
        net.restore(robot_at, address)
        wait_for(lambda: robot.ready(2))
