"""What a robot holds for a replica that takes nothing: bounded, whatever the others answer."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from functools import partial
from itertools import count

from fogft.counters import Counters
from fogft.link.frame import Greeting
from fogft.link.zenoh.replica.control_queries import ControlQueries
from fogft.link.zenoh.replica.query_ends import QueryEnd
from fogft.link.zenoh.replica.reply_queue import ReplyQueues
from fogft.link.zenoh.replica.reply_streams import Streams
from fogft.link.zenoh.replica.sessions import AuthenticatedSessions
from fogft.link.zenoh.robot.link import ZenohLink
from fogft.link.zenoh.settings import LinkSettings
from fogft.link.zenoh.work_queue import LIMIT, WorkQueue
from fogft.records.record_set import RecordSet
from fogft.records.signing import Verifier
from tests.link.wire_pool import POOL_UID, SERVICE, Authority, ReplicaProcess, request_id, wait_for

# A send to the frozen replica blocks for longer than any test waits.
STUCK = LinkSettings(
    lease_s=300.0, wait_before_close_s=200.0, stall_after_s=3600.0, stuck_after_s=3600.0
)
IN_THE_SENDERS_HANDS = 8  # passed to Zenoh before its queue and the socket were full


def frozen(start: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink]) -> ZenohLink:
    replica = start(settings=STUCK)
    link = dial(replica.endpoint, suspect_after_s=3600.0, settings=STUCK)
    wait_for(lambda: link.usable)
    replica.signal(signal.SIGSTOP)
    return link


def test_a_forgotten_request_is_not_kept_for_a_sender_that_is_stuck(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink]
) -> None:
    """The winner's answer frees a loser's bytes, though the loser's sender blocks."""
    link = frozen(start_replica, dial)
    payloads = [os.urandom(1 << 20) for _ in range(60)]
    free = sys.getrefcount(payloads[0])
    for number, payload in enumerate(payloads):
        assert link.offer(SERVICE, request_id(number), payload, 60.0)
        link.forget(request_id(number))
    del payload
    held = sum(sys.getrefcount(payloads[n]) > free for n in range(len(payloads)))
    assert held <= IN_THE_SENDERS_HANDS
    assert link.status().in_flight == 0


def test_a_stuck_sender_is_not_given_requests_without_end(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink]
) -> None:
    """Forgetting frees the window, so the queue behind it has a bound of its own."""
    link = frozen(start_replica, dial)
    for number in range(40):  # enough to fill all that lies below the sender
        link.offer(SERVICE, request_id(number), bytes(1 << 20), 60.0)
    taken = 0
    for number in range(100, 10_100):
        taken += link.offer(SERVICE, request_id(number), b"q", 60.0)
        link.forget(request_id(number))
    assert taken < 2000


def test_small_requests_to_a_frozen_replica_never_block(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink]
) -> None:
    """They are sent by the caller's own thread only while the buffers below surely hold them."""
    link = frozen(start_replica, dial)
    payload = bytes(1 << 14)
    for number in range(2_000):  # 32 MB: far more than all buffers hold; a block would hang
        link.offer(SERVICE, request_id(number), payload if number % 2 else b"q", 60.0)
        link.forget(request_id(number))
    assert link.usable


class Query:
    """Stands in for one of Zenoh's that nobody answers."""

    ended = 0

    def drop(self) -> None:
        type(self).ended += 1


def test_what_waits_at_a_replica_besides_requests_is_bounded(authority: Authority) -> None:
    """A robot that probes without end has its probes dropped and counted, and each query ended."""
    counters, turns = Counters(), count()
    verifier = Verifier(authority.replica().ca, lazy=True)
    work = WorkQueue("test", counters)  # not begun: nothing leaves it
    control = ControlQueries(
        sessions=AuthenticatedSessions(POOL_UID, "replica", verifier),
        records=RecordSet(POOL_UID, verifier),
        streams=Streams(),
        queues=ReplyQueues(counters),
        work=work,
        counters=counters,
    )
    for _ in range(3000):
        asked = QueryEnd(Query(), partial(next, turns))
        control.later(Greeting(bytes(8)), lambda: None, asked)
    dropped = counters.snapshot()["control_queries_dropped"]
    assert 0 < 3000 - dropped <= LIMIT
    wait_for(lambda: Query.ended == dropped)
