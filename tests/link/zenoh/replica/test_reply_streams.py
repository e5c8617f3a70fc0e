"""Where a connection's answers come from: one open query, and what is still awaited on it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.link import frame
from fogft.link.compression import ASIDE_BYTES
from fogft.link.port import Incoming, Probe, ProbeAnswer
from fogft.link.window import OpenAttempt, Unanswered
from fogft.link.zenoh.replica.listener import ZenohListener
from fogft.link.zenoh.replica.reply_streams import CREDIT_LIMIT, Streams
from fogft.link.zenoh.robot.link import ZenohLink
from fogft.model.replica import ReplicaId
from tests.link.wire_pool import (
    POOL_UID,
    SERVICE,
    Authority,
    Owner,
    ReplicaProcess,
    keys,
    request_id,
    wait_for,
)


@given(st.lists(st.integers(0, 9)), st.integers(1, 5))
def test_every_query_is_either_open_or_ended_once(tokens: list[int], limit: int) -> None:
    """The last of each of the youngest tokens stays; all others are given back to be ended."""
    streams, ended, opened = Streams(), [], []
    streams.limit = limit
    for number, token in enumerate(tokens):
        query: Any = (token, number)
        opened.append(query)
        ended += streams.opened(bytes([token]), query, "holder")
    found = [streams.of(bytes([token])) for token in range(10)]
    kept: list[Any] = [stream.query for stream in found if stream is not None]
    youngest = sorted(dict(opened).items(), key=lambda item: item[1])[-limit:]
    assert sorted(kept) == sorted(youngest)
    assert sorted([query for _, query in ended] + kept) == sorted(opened)
    assert all(token == bytes([query[0]]) for token, query in ended)


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 20))), st.integers(8, 12))
def test_an_answer_finds_its_request_once(steps: list[tuple[bool, int]], limit: int) -> None:
    """Beyond the bound it is the oldest that are not found."""
    unanswered, sent = Unanswered(), {}
    unanswered.limit = limit
    for sends, number in steps:
        if sends:
            attempt = OpenAttempt("/s", request_id(number), b"", 0, offered=0.0, deadline=1.0)
            unanswered.add(attempt)
            sent[number] = attempt
        else:
            found = unanswered.answered(request_id(number))
            assert found in (None, sent.pop(number, None))
        assert len(unanswered) <= limit
        if sends:
            assert unanswered.answered(request_id(number)) is attempt
            unanswered.add(attempt)


def test_many_connections_one_after_another_leave_little_behind(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """Each hears its own answers only, though the replica keeps the queries of those before it."""
    replica = start_replica()
    for number in range(30):
        link = dial(replica.endpoint)
        wait_for(lambda link=link: link.usable)  # type: ignore[misc]
        assert link.offer(SERVICE, request_id(number), b"%d" % number, 20.0)
        wait_for(lambda number=number: owner.of(number))  # type: ignore[misc]
        link.close()
    assert [a.payload for _, a in owner.answers] == [b"%d" % n for n in range(30)]
    assert replica.count("failed") == 0


def test_a_connection_whose_answers_have_ended_is_replaced(
    authority: Authority, dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """What is under way there is lost, and told so; what is asked next is answered."""
    held: list[Incoming] = []
    listener = ZenohListener("127.0.0.1:0", authority.replica(), ReplicaId(POOL_UID, 0, 1))

    def answer_probe(probe: Probe) -> ProbeAnswer:
        return ProbeAnswer(slot=0, generation=1, incarnation="here", ready=frozenset({SERVICE}))

    listener.serve(keys(0), held.append, answer_probe)
    try:
        link = dial(listener.endpoint)
        wait_for(lambda: link.usable)
        assert link.offer(SERVICE, request_id(1), b"first", 60.0)
        wait_for(lambda: len(held) == 1)
        held.clear()
        listener.streams.clear()
        wait_for(lambda: owner.of(1))
        wait_for(lambda: link.usable and link.status().reopened == 1)
        assert link.offer(SERVICE, request_id(2), b"second", 60.0)
        wait_for(lambda: len(held) == 1)
        held[0].reply(held[0].payload)
        wait_for(lambda: owner.of(2))
        assert owner.of(2)[0].payload == b"second"
    finally:
        listener.close()


class Answering:
    """A replica in this process, and which thread sends what it answers."""

    def __init__(self, authority: Authority, monkeypatch: pytest.MonkeyPatch) -> None:
        self.arrived: list[Incoming] = []
        self.answers_itself = False
        self.senders: list[str] = []
        self.takers: list[str] = []
        encode = frame.encode_answer

        def noted(*args: Any, **rest: Any) -> bytes:
            self.senders.append(threading.current_thread().name)
            return encode(*args, **rest)

        monkeypatch.setattr(frame, "encode_answer", noted)
        id = ReplicaId(POOL_UID, 0, 1)
        self.listener = ZenohListener("127.0.0.1:0", authority.replica(), id)
        self.listener.serve(
            keys(0),
            self._take,
            lambda probe: ProbeAnswer(
                slot=0, generation=1, incarnation="here", ready=frozenset({SERVICE})
            ),
        )

    def _take(self, incoming: Incoming) -> None:
        self.takers.append(threading.current_thread().name)
        if self.answers_itself:
            incoming.reply(incoming.payload)
        self.arrived.append(incoming)


@pytest.fixture
def answering(authority: Authority, monkeypatch: pytest.MonkeyPatch) -> Iterator[Answering]:
    one = Answering(authority, monkeypatch)
    yield one
    one.listener.close()


def test_an_answer_to_a_robot_that_hears_leaves_from_the_thread_that_brings_it(
    answering: Answering, dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """No other thread is woken for it: that costs a twentieth of a round trip."""
    link = dial(answering.listener.endpoint)
    wait_for(lambda: link.usable)
    for number in range(20):
        assert link.offer(SERVICE, request_id(number), b"%d" % number, 60.0)
        wait_for(lambda number=number: len(answering.arrived) > number)  # type: ignore[misc]
        answering.arrived[number].reply(b"to %d" % number)
        wait_for(lambda number=number: owner.of(number))  # type: ignore[misc]
        assert owner.of(number)[0].payload == b"to %d" % number
    assert answering.senders == [threading.current_thread().name] * 20


def test_a_robot_that_does_not_say_what_it_saw_is_answered_by_the_thread_that_may_block(
    answering: Answering, dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """All but a few of what came at once: it may be frozen by now."""
    link = dial(answering.listener.endpoint)
    wait_for(lambda: link.usable)
    for number in range(20):
        assert link.offer(SERVICE, request_id(number), b"%d" % number, 60.0)
    wait_for(lambda: len(answering.arrived) == 20)
    for number, incoming in enumerate(answering.arrived):
        incoming.reply(bytes(5000) + b"%d" % number)  # too large to share a message
    wait_for(lambda: len(owner.answers) == 20)
    assert [owner.of(n)[0].payload for n in range(20)] == [bytes(5000) + b"%d" % n
                                                           for n in range(20)]  # fmt: skip
    own = threading.current_thread().name
    assert answering.senders.count(own) == CREDIT_LIMIT
    assert all(name == own or name.startswith("fogft-reply-") for name in answering.senders)


def test_an_answer_that_others_will_follow_waits_for_them_in_the_queue(
    answering: Answering, dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    link = dial(answering.listener.endpoint)
    wait_for(lambda: link.usable)
    assert link.offer(SERVICE, request_id(1), b"x", 60.0)
    wait_for(lambda: answering.arrived)
    answering.arrived[0].reply(b"y", more=True)
    wait_for(lambda: owner.of(1))
    assert all(name.startswith("fogft-reply-") for name in answering.senders)
    assert len(answering.senders) == 1


def test_zenohs_own_thread_never_sends(
    answering: Answering, dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """It would wait for room that only it can make."""
    answering.answers_itself = True
    link = dial(answering.listener.endpoint)
    wait_for(lambda: link.usable)
    for number in range(3):
        assert link.offer(SERVICE, request_id(number), b"x", 60.0)
        wait_for(lambda number=number: owner.of(number))  # type: ignore[misc]
    assert all(name.startswith("fogft-reply-") for name in answering.senders)
    assert len(answering.senders) == 3


def test_a_large_request_is_taken_off_the_thread_that_receives_for_all(
    answering: Answering, dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """Checking its bytes can take seconds."""
    link = dial(answering.listener.endpoint)
    wait_for(lambda: link.usable)
    for number, size in enumerate((ASIDE_BYTES + 1, 1)):
        assert link.offer(SERVICE, request_id(number), bytes(size), 60.0)
        wait_for(lambda number=number: len(answering.takers) > number)  # type: ignore[misc]
    large, small = answering.takers
    assert large.startswith("fogft-unpack-robot.")
    assert not small.startswith("fogft-")
    for incoming in answering.arrived:
        incoming.reply(b"")
    wait_for(lambda: len(owner.answers) == 2)
