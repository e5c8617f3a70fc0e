"""The fastest replica's answer arrives while slower ones still work."""

from __future__ import annotations

from collections.abc import Callable

from fogft.link.zenoh.robot.link import ZenohLink
from tests.link.wire_pool import SERVICE, Owner, ReplicaProcess, request_id, wait_for


def test_first_reply_is_not_held_back(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """Of three replicas that answer at once, later and never, each is heard when it answers."""
    delays_s = (0.0, 3.0, 3600.0)
    replicas = [start_replica(slot=n, delay_s=delay_s) for n, delay_s in enumerate(delays_s)]
    links = [dial(replica.endpoint, slot=n) for n, replica in enumerate(replicas)]
    wait_for(lambda: all(link.usable for link in links))
    for link in links:
        assert link.offer(SERVICE, request_id(1), b"who is first", 60.0)
    wait_for(lambda: len(owner.answers) == 2)
    assert [slot for slot, _ in owner.answers] == [0, 1]
    assert [link.status().in_flight for link in links] == [0, 0, 1]


def test_each_answer_of_one_link_arrives_when_it_is_ready(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """A slow request does not hold back a quick one that was sent after it."""
    replica = start_replica(delay_s=3600.0)
    link = dial(replica.endpoint)
    wait_for(lambda: link.usable)
    link.offer(SERVICE, request_id(1), b"slow", 60.0)
    wait_for(lambda: replica.count("requests") == 1)
    replica.ask(delay_s=0.0)
    link.offer(SERVICE, request_id(2), b"quick", 60.0)
    wait_for(lambda: owner.of(2))
    assert owner.of(1) == []
