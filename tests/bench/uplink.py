"""What a robot sends for a request, through a gateway and without one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.link.wire_pool import wait_for
from tests.proxy.counting_relay import CountingRelay
from tests.proxy.gateway_pool import GatewayPool, Robot

REPLICAS = (1, 2, 4)
PAYLOAD_BYTES = 100_000
_START_S = 300.0  # many processes on a machine that may be busy


def uplink(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Count the bytes of TCP from the robot, for pools of one, two and four replicas.

    Probes and what else the links say are counted; headers of packets are not.
    """
    requests = 50 if quick else 500
    return [
        {"replicas": count, **of_pool(folder / str(count), count, requests)} for count in REPLICAS
    ]


def of_pool(folder: Path, replicas: int, requests: int, *, delay_s: float = 0.0) -> dict[str, Any]:
    """Return bytes per request as a multiple of the payload, both ways of asking.

    A service that answers at once (`delay_s`) saves a robot what has not left it by then.
    """
    folder.mkdir()
    pool = GatewayPool(folder, timeout_s=60.0, services=", hedging: all")
    relays: list[CountingRelay] = []
    try:
        for slot in range(replicas):
            pool.replica(slot, delay_s=delay_s)
            relays.append(CountingRelay(pool.endpoint(slot)))
        gateway = pool.gateway("edge")
        relay = CountingRelay(gateway.endpoint())
        relays.append(relay)
        pool.lay_out({"edge": (relay.endpoint, ())}, {"behind": ["edge"]})
        behind = pool.robot("behind")
        wait_for(behind.ready, _START_S)
        wait_for(lambda: len(_ready(behind)) == replicas, _START_S)
        through = _sent([relay], behind, requests)
        for slot, to_replica in enumerate(relays[:replicas]):
            pool.reach(slot, to_replica.endpoint)
        direct = pool.robot("direct")
        wait_for(lambda: direct.ready(replicas), _START_S)
        return {
            "payload_bytes": PAYLOAD_BYTES,
            "requests": requests,
            "through_a_gateway": through,
            "directly": _sent(relays[:replicas], direct, requests),
        }
    finally:
        pool.close()
        for one in relays:
            one.close()


def _ready(robot: Robot) -> list[Any]:
    return [link for link in robot.tell()["report"]["links"] if link["ready"]]


def _sent(relays: list[CountingRelay], robot: Robot, requests: int) -> float:
    before = sum(relay.up_bytes for relay in relays)
    for _ in range(requests // 10):
        robot.ask(10, PAYLOAD_BYTES)
        robot.all_right()
    robot.settle()
    return (sum(relay.up_bytes for relay in relays) - before) / (requests * PAYLOAD_BYTES)
