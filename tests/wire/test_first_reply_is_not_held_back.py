"""The fastest replica's answer arrives while slower ones still work."""

from __future__ import annotations

from collections.abc import Callable

import zenoh

from fogft.core import names
from fogft.core.model import ReplicaId
from fogft.wire import config, frame
from fogft.wire.config import LinkSettings
from fogft.wire.port import ProbeAnswer
from fogft.wire.zenoh_link import ZenohLink
from fogft.wire.zenoh_listener import ZenohListener
from tests.wire.wire_pool import (
    POOL_UID,
    SERVICE,
    Authority,
    Owner,
    ReplicaProcess,
    keys,
    request_id,
    wait_for,
)


def test_first_reply_is_not_held_back(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """Of three replicas that answer at once, later and never, each is heard when it answers."""
    delays_s = (0.0, 0.3, 3600.0)
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


def test_a_reply_is_heard_before_the_query_is_over(
    authority: Authority, dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """Two queryables hear one query and the second never answers: the first is heard at once.

    With Zenoh's default consolidation the first reply would wait for the second.
    """
    id = ReplicaId(POOL_UID, 0, 1)
    endpoint = ZenohListener("127.0.0.1:0", authority.replica(), id).endpoint
    settings = config.replica_settings(endpoint, id, authority.replica(), LinkSettings())
    session = zenoh.open(config.to_zenoh(settings))
    held: list[zenoh.Query] = []

    def answer_probe(query: zenoh.Query) -> None:
        answer = ProbeAnswer(0, 1, "raw", frozenset({SERVICE}))
        query.reply(query.key_expr, frame.encode_probe_answer(answer))

    def answer_request(query: zenoh.Query) -> None:
        query.reply(query.key_expr, b"first", attachment=frame.encode_answer(request_id(1)))

    try:
        key = keys(0)[SERVICE]
        kept = [
            session.declare_queryable(key, held.append),
            session.declare_queryable(key, answer_request),
            session.declare_queryable(names.probe_key(POOL_UID, 0), answer_probe),
        ]
        link = dial(endpoint)
        wait_for(lambda: link.usable)
        link.offer(SERVICE, request_id(1), b"", 3600.0)
        wait_for(lambda: owner.of(1))
        assert owner.of(1)[0].payload == b"first"
        assert len(held) == 1
        del kept
    finally:
        held.clear()
        session.close()
