"""Delay, jitter and loss between a robot and its replicas: every request has its own answer, once.

Packets are lost on a network of the test's own (root); the variant over loopback, which always
runs, has delay and jitter, since a relay of TCP can lose nothing.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.link.rough_cable import RoughCable
from tests.link.thin_relay import ThinRelay
from tests.link.wire_pool import SERVICE, wait_for
from tests.needs import needs
from tests.proxy.gateway_pool import GatewayPool, Robot, ran

ROBOT, CLOUD = "10.85.1.1", "10.85.1.2"
LIMIT_S = 110.0
SIZES = (8, 1000, 20_000, 60_000)
pytestmark = pytest.mark.timeout(240)


@pytest.fixture
def pool(tmp_path) -> Iterator[GatewayPool]:
    made = GatewayPool(tmp_path, timeout_s=100.0)
    yield made
    made.close()


def ask(pool: GatewayPool, robot: Robot) -> None:
    """Have requests of all sizes under way together, several times."""
    wait_for(lambda: robot.ready(2), LIMIT_S)
    for _ in range(2):
        for size in SIZES:
            robot.ask(4, size)
        wait_for(lambda: (told := robot.tell())["right"] == told["asked"] or told["wrong"], LIMIT_S)
    told = robot.tell()
    assert (told["right"], told["wrong"]) == (32, [])
    counts = told["report"]["services"][SERVICE]
    assert (counts["silent"], counts["turned_away"]) == (0, 0)
    for numbers in ran(pool.folder).values():
        assert set(numbers.values()) <= {1}


@needs("namespaces", "tun")
def test_packets_that_are_late_out_of_order_and_lost_cost_no_request(pool, net):
    """40 to 80 ms each way, and three packets in a hundred lost."""
    robot_at, cloud = net.add("r"), net.add("c")
    cable = RoughCable(
        robot_at, ROBOT, cloud, CLOUD, delay_s=0.04, jitter_s=0.04, loss=0.03, seed=7
    )
    servers = [pool.server_proxy(slot, where=cloud, host=CLOUD) for slot in (0, 1)]
    try:
        ask(pool, pool.robot("ada", where=robot_at))
        assert cable.lost > 10
    finally:
        for server in servers:
            server.kill()
            server.wait()
        cable.close()


def test_delay_and_jitter_through_relays_cost_no_request(pool):
    """Up to 30 ms more for each piece, so that probes and answers come when they like."""
    servers = [pool.server_proxy(slot) for slot in (0, 1)]
    relays = [ThinRelay(pool.endpoint(slot)) for slot in (0, 1)]
    for slot, relay in enumerate(relays):
        relay.delay_s, relay.jitter_s = 0.005, 0.03
        pool.reach(slot, relay.endpoint)
    pool.publish()
    try:
        ask(pool, pool.robot("ada"))
    finally:
        for server in servers:
            server.kill()
            server.wait()
        for relay in relays:
            relay.close()
