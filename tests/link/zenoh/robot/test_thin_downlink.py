"""A robot whose downlink is thin: what shrinks of its responses is compressed, and nothing else.

Its requests are small, so that only the replica can tell. On a network of the test's own with the
kernel's token buckets (root), and over loopback through a slow relay, which always runs.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from fogft.link.port import SendOptions
from fogft.link.zenoh.robot.dialer import ZenohDialer
from fogft.link.zenoh.robot.link import ZenohLink
from fogft.link.zenoh.settings import LinkSettings
from tests.link.namespaces import Namespaces, inside
from tests.link.thin_relay import ThinRelay
from tests.link.wire_pool import (
    POOL_UID,
    SERVICE,
    Authority,
    Owner,
    ReplicaProcess,
    keys,
    peer,
    request_id,
    wait_for,
)
from tests.link.zenoh.replica_process import content

ROBOT, REPLICA = "10.84.1.1", "10.84.1.2"
MBIT, LONG_S = 1.0, 90.0
NOISE, TEXT = b"noise:400000", b"text:1000000"  # 3.2 s and 8 s at 1 Mbit/s
# A busy machine is no silence.
PATIENT: dict[str, Any] = {
    "suspect_after_s": LONG_S,
    "settings": LinkSettings(stall_after_s=LONG_S, stuck_after_s=LONG_S),
}


class Asking:
    """A robot that asks one request after the other.

    Args:
        sent: Returns how many bytes have gone to the robot.
    """

    def __init__(
        self, dialer: ZenohDialer, endpoint: str, owner: Owner, sent: Callable[[], int]
    ) -> None:
        self.link: ZenohLink = dialer.dial(peer(endpoint), keys(0), owner)
        self._owner = owner
        self._sent = sent
        self._count = 0
        wait_for(lambda: self.link.usable, LONG_S)

    def ask(self, wanted: bytes) -> float:
        """Ask for bytes, check them, and return which part of them was sent."""
        self._count += 1
        before, number = self._sent(), self._count
        assert self.link.offer(SERVICE, request_id(number), wanted, LONG_S)
        wait_for(lambda: self._owner.of(number), LONG_S)
        (answer,) = self._owner.of(number)
        assert answer.payload == content(wanted)
        return (self._sent() - before) / len(content(wanted))


def check(asking: Asking) -> None:
    """By the first responses the replica sees that the link is thin."""
    assert asking.ask(NOISE) > 0.95
    assert any(asking.ask(TEXT) < 0.2 for _ in range(4))
    assert asking.ask(b"noise:50000") > 0.95
    assert any(asking.ask(TEXT) < 0.2 for _ in range(4))
    assert asking.link.status().reopened == 0


def test_through_a_relay(
    start_replica: Callable[..., ReplicaProcess], authority: Authority, owner: Owner
) -> None:
    relay = ThinRelay(start_replica().endpoint, MBIT * 125_000)
    dialer = ZenohDialer(authority.robot(), robot="robot", pool_uid=POOL_UID, **PATIENT)
    try:
        check(Asking(dialer, relay.endpoint, owner, lambda: relay.passed_bytes))
    finally:
        dialer.close()
        relay.close()


def test_a_response_may_take_long(
    start_replica: Callable[..., ReplicaProcess], authority: Authority, owner: Owner
) -> None:
    """It arrives over the same connection, however little of it the kernel holds meanwhile."""
    relay = ThinRelay(start_replica().endpoint, 4 * MBIT * 125_000)
    dialer = ZenohDialer(authority.robot(), robot="robot", pool_uid=POOL_UID, **PATIENT)
    try:
        asking = Asking(dialer, relay.endpoint, owner, lambda: relay.passed_bytes)
        assert asking.ask(b"noise:700000") > 0.95  # by which the replica sees that the link is thin
        assert asking.ask(b"noise:5600000") > 0.95  # 11.2 s
        assert asking.link.status().reopened == 0
    finally:
        dialer.close()
        relay.close()


def test_a_service_that_wants_none_gets_none(
    start_replica: Callable[..., ReplicaProcess], authority: Authority, owner: Owner
) -> None:
    relay = ThinRelay(start_replica().endpoint, 4 * MBIT * 125_000)
    dialer = ZenohDialer(authority.robot(), robot="robot", pool_uid=POOL_UID, **PATIENT)
    dialer.adopt(SendOptions(plain=frozenset({SERVICE})))
    try:
        asking = Asking(dialer, relay.endpoint, owner, lambda: relay.passed_bytes)
        assert [asking.ask(b"text:500000") > 0.95 for _ in range(2)] == [True, True]
    finally:
        dialer.close()
        relay.close()


@pytest.mark.own_process
def test_over_a_thin_cable(authority: Authority, net: Namespaces, owner: Owner) -> None:
    robot_at, replica_at = net.add("r"), net.add("p")
    _, far = net.join(robot_at, ROBOT, replica_at, REPLICA)
    net.limit(replica_at, far, MBIT)
    with inside(replica_at):
        replica = ReplicaProcess(authority.replica(), endpoint=f"{REPLICA}:7447")
    try:
        with inside(robot_at):
            dialer = ZenohDialer(authority.robot(), robot="robot", pool_uid=POOL_UID, **PATIENT)
            try:
                sent = partial(net.sent_bytes, replica_at, far)
                check(Asking(dialer, replica.endpoint, owner, sent))
            finally:
                dialer.close()
    finally:
        replica.kill()
