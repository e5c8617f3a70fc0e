"""A replica that has an IPv6 address only."""

from __future__ import annotations

from collections.abc import Callable

from fogft.link.zenoh.robot.link import ZenohLink
from tests.link.wire_pool import SERVICE, Owner, ReplicaProcess, request_id, wait_for


def test_a_link_to_an_ipv6_address_is_one_like_any_other(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """It answers, and the replica takes neither its robot nor anybody else for a stranger."""
    replica = start_replica(endpoint="[::1]:0")
    link = dial(replica.endpoint)
    wait_for(lambda: link.usable)
    assert link.offer(SERVICE, request_id(1), b"x", 30.0)
    wait_for(lambda: owner.of(1))
    assert owner.of(1)[0].payload == b"x"
    assert replica.count("unauthenticated") == 0
    assert link.status().reopened == 0
