"""Uplinks of a few Mbit/s: large requests take long there, and no link is given up for that.

On networks of the test's own with the kernel's token buckets (root), and over loopback through
a slow relay, which always runs.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from typing import Any

import pytest

from fogft.link.port import SendOptions
from fogft.link.zenoh.robot.dialer import ZenohDialer
from fogft.link.zenoh.robot.link import ZenohLink
from fogft.link.zenoh.settings import LinkSettings
from fogft.model.replica import LinkState
from tests.link.namespaces import inside
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
from tests.needs import needs

pytestmark = pytest.mark.timeout(180)
MEGABYTE = os.urandom(1_000_000)
ROBOT, REPLICA = "10.81.1.1", "10.81.1.2"
LONG_S = 90.0
# A busy machine is no silence, and a megabyte takes longer than that.
PATIENT: dict[str, Any] = {"suspect_after_s": 4.0, "settings": LinkSettings(stall_after_s=4.0)}


def answered(owner: Owner, *numbers: int) -> Callable[[], bool]:
    return lambda: all(owner.of(number) for number in numbers)


def never_given_up(owner: Owner, links: list[ZenohLink], asked: int) -> None:
    """Each attempt was answered, at the first try, by a link that was never in doubt."""
    assert [a.refusal for _, a in owner.answers if a.payload is None] == []
    assert len(owner.answers) == asked
    assert [link.status().reopened for link in links] == [0] * len(links)
    assert LinkState.SUSPECT not in [state for _, state in owner.states]


@pytest.mark.own_process
@pytest.mark.parametrize(
    ("mbit", "reply_bytes"), [(1, 16), pytest.param(2, 16, marks=needs("night")), (5, -1)]
)
def test_a_megabyte_gets_through_a_thin_uplink(authority, net, owner, mbit, reply_bytes):
    """At 1, 2 and 5 Mbit/s, up, and down at 5; so much silence would be suspected."""
    robot_at, replica_at = net.add("r"), net.add("p")
    near, far = net.join(robot_at, ROBOT, replica_at, REPLICA)
    net.limit(robot_at, near, mbit)
    net.limit(replica_at, far, mbit)
    with inside(replica_at):
        replica = ReplicaProcess(
            authority.replica(), endpoint=f"{REPLICA}:7447", reply_bytes=reply_bytes
        )
    with inside(robot_at):
        dialer = ZenohDialer(authority.robot(), robot="robot", pool_uid=POOL_UID, **PATIENT)
        try:
            link = dialer.dial(peer(replica.endpoint), keys(0), owner)
            wait_for(lambda: link.usable)
            assert link.offer(SERVICE, request_id(1), MEGABYTE, LONG_S)
            assert link.offer(SERVICE, request_id(2), b"small", LONG_S)
            wait_for(answered(owner, 1, 2), LONG_S)
            never_given_up(owner, [link], 2)
        finally:
            dialer.close()
            replica.kill()


@pytest.mark.own_process
def test_a_blackhole_on_a_thin_uplink_is_told_from_a_slow_one(authority, net, owner):
    """What flows is let flow; what stands still is given up, and comes back with the path."""
    robot_at, replica_at = net.add("r"), net.add("p")
    near, _ = net.join(robot_at, ROBOT, replica_at, REPLICA)
    net.limit(robot_at, near, 5)
    with inside(replica_at):
        replica = ReplicaProcess(authority.replica(), endpoint=f"{REPLICA}:7447", reply_bytes=16)
    with inside(robot_at):
        dialer = ZenohDialer(authority.robot(), robot="robot", pool_uid=POOL_UID, **PATIENT)
        try:
            link = dialer.dial(peer(replica.endpoint), keys(0), owner)
            wait_for(lambda: link.usable)
            assert link.offer(SERVICE, request_id(1), MEGABYTE, LONG_S)
            net.blackhole(replica_at, ROBOT)
            wait_for(lambda: not link.usable, LONG_S)
            wait_for(answered(owner, 1))
            net.restore(replica_at, ROBOT)
            wait_for(lambda: link.usable, LONG_S)
            assert link.offer(SERVICE, request_id(1), MEGABYTE, LONG_S)
            wait_for(lambda: len(owner.of(1)) == 2, LONG_S)
            assert owner.of(1)[1].payload == bytes(16)
        finally:
            dialer.close()
            replica.kill()


def test_a_large_request_through_a_slow_relay_leaves_links_alone(
    start_replica: Callable[..., ReplicaProcess], authority: Authority, owner: Owner
) -> None:
    """Two replicas with 1 Mbit/s each; a copy takes far longer than silence may last."""
    replicas = [start_replica(slot=slot, reply_bytes=16) for slot in (0, 1)]
    relays = [ThinRelay(replica.endpoint, 125_000) for replica in replicas]
    dialer = ZenohDialer(authority.robot(), robot="robot", pool_uid=POOL_UID, **PATIENT)
    try:
        links = [dialer.dial(peer(r.endpoint, n), keys(n), owner) for n, r in enumerate(relays)]
        wait_for(lambda: all(link.usable for link in links))
        assert not any(link.thin for link in links)
        for link in links:
            assert link.offer(SERVICE, request_id(1), MEGABYTE, LONG_S)
        wait_for(lambda: len(owner.of(1)) == 2, LONG_S)
        assert all(link.thin for link in links)
        never_given_up(owner, links, 2)
    finally:
        dialer.close()
        for relay in relays:
            relay.close()


def test_what_shrinks_is_compressed_once_the_uplink_was_seen_to_be_thin(
    start_replica: Callable[..., ReplicaProcess], authority: Authority, owner: Owner
) -> None:
    """Both ways, and what comes back is what was sent; noise leaves as it is."""
    relay = ThinRelay(start_replica().endpoint, 250_000)
    dialer = ZenohDialer(authority.robot(), robot="robot", pool_uid=POOL_UID, **PATIENT)
    text = b"the quick brown fox jumps over the lazy dog " * 20_000
    noise = MEGABYTE[:400_000]
    try:
        link = dialer.dial(peer(relay.endpoint), keys(0), owner)
        wait_for(lambda: link.usable)
        for number, payload in enumerate((noise, text, noise)):
            before = relay.passed_bytes
            assert link.offer(SERVICE, request_id(number), payload, LONG_S)
            wait_for(answered(owner, number), LONG_S)
            assert owner.of(number)[0].payload == payload
            passed = relay.passed_bytes - before
            if payload is text:
                assert passed < len(text) / 5, passed
            else:
                assert passed > 2 * len(noise), passed
        never_given_up(owner, [link], 3)
    finally:
        dialer.close()
        relay.close()


def test_the_newest_request_overtakes_stale_ones_where_the_service_says_so(
    start_replica: Callable[..., ReplicaProcess], authority: Authority, owner: Owner
) -> None:
    """While one large request leaves, others wait; the last to come is the next to leave."""
    relay = ThinRelay(start_replica(reply_bytes=16).endpoint, 500_000)
    dialer = ZenohDialer(authority.robot(), robot="robot", pool_uid=POOL_UID, **PATIENT)
    dialer.adopt(SendOptions(latest=frozenset({SERVICE})))
    try:
        link = dialer.dial(peer(relay.endpoint), keys(0), owner)
        wait_for(lambda: link.usable)
        for number in range(6):
            assert link.offer(SERVICE, request_id(number), MEGABYTE[:400_000], LONG_S)
        wait_for(lambda: len(owner.answers) == 6, LONG_S)
        order = [int.from_bytes(a.request_id, "big") for _, a in owner.answers]
        late = order[order.index(5) :]  # the first few left before the last one came
        assert late == sorted(late, reverse=True)
        assert len(late) >= 3
    finally:
        dialer.close()
        relay.close()


def test_a_replica_that_freezes_under_a_large_request_is_found_out(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """Nothing of what is sent is taken any more: given up long before probes would tell."""
    replica = start_replica(reply_bytes=16)
    link = dial(replica.endpoint, suspect_after_s=3600.0)
    wait_for(lambda: link.usable)
    replica.signal(signal.SIGSTOP)
    for number in range(30):  # more than all buffers on the way hold
        link.offer(SERVICE, request_id(number), MEGABYTE, LONG_S)
    wait_for(lambda: not link.usable)
    assert link.status().state is LinkState.SUSPECT
    replica.signal(signal.SIGCONT)
    wait_for(lambda: link.usable, LONG_S)
