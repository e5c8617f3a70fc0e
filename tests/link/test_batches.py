"""What came together leaves together: the bytes, what is held, and real links."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from queue import Empty
from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from fogft.byte_limit import SMALL_BYTES
from fogft.counters import Counters
from fogft.errors import FrameError
from fogft.link import batch_frames, frame
from fogft.link.frame import NO_LOAD, NO_STAMP
from fogft.link.port import Incoming, Probe, ProbeAnswer
from fogft.link.window import BatchBuffer, OpenAttempt
from fogft.link.zenoh import settings as config
from fogft.link.zenoh.replica.listener import ZenohListener
from fogft.link.zenoh.replica.query_ends import QueryEnd
from fogft.link.zenoh.replica.reply_queue import BYTES_LIMIT as REPLY_BYTES_LIMIT
from fogft.link.zenoh.replica.reply_queue import Reply, ReplyQueue, ReplyQueues
from fogft.link.zenoh.robot.link import ZenohLink
from fogft.link.zenoh.settings import LinkSettings
from fogft.model.keys import LONGEST_S
from fogft.model.refusal import Refusal
from fogft.model.replica import ReplicaId
from fogft.requests.load import Handling, Load
from tests.link.wire_pool import (
    POOL_UID,
    SERVICE,
    Authority,
    Owner,
    hears,
    keys,
    peer,
    request_id,
    wait_for,
)

ids = st.binary(min_size=16, max_size=16)
payloads = st.binary(max_size=40)
stamps = st.binary(min_size=4, max_size=4)
ORIGIN = frame.origin("ada", bytes(8))
loads = st.sampled_from([NO_LOAD, frame.encode_load(Load(3, 1, 2, 0.5, 0.25))])
handlings = st.sampled_from([Handling.NORMAL, Handling.DROP_IF_BUSY, Handling.ALONE])
requests = st.lists(
    st.tuples(ids, st.floats(0, LONGEST_S), st.sampled_from(list(Handling)), payloads),
    min_size=1,
    max_size=8,
)
answers = st.lists(
    st.tuples(ids, loads, payloads, st.sampled_from(["", Refusal.CANCELLED, Refusal.LATE])),
    min_size=1,
    max_size=8,
)


@given(requests, stamps)
def test_requests_come_back_in_their_order(
    sent: list[tuple[bytes, float, Handling, bytes]], seen: bytes
) -> None:
    header, content = batch_frames.encode_requests(sent, ORIGIN, seen=seen)
    found = batch_frames.decode_requests(header, content)
    came = [(one.request_id, one.remaining_s, one.handling, payload) for one, payload in found]
    assert came == sent
    assert all((one.token, one.robot, one.seen) == (bytes(8), "ada", seen) for one, _ in found)
    assert not any(one.packed or one.may_pack or one.reads_packed for one, _ in found)


@given(answers, stamps)
def test_answers_come_back_in_their_order(
    sent: list[tuple[bytes, bytes, bytes, str]], stamp: bytes
) -> None:
    """A refusal travels in place of its payload."""
    header, content = batch_frames.encode_answers(stamp, sent)
    came, found = batch_frames.decode_answers(header, content)
    assert came == stamp
    assert [(one.request_id, one.refusal) for one in found] == [
        (id, why or None) for id, _, _, why in sent
    ]
    assert [one.payload for one in found] == [None if why else said for _, _, said, why in sent]
    assert [frame.encode_load(one.load) for one in found] == [load for _, load, _, _ in sent]


def test_a_batch_is_no_single_frame_and_the_other_way_round() -> None:
    """So that neither is ever taken for the other."""
    header, content = batch_frames.encode_requests([(bytes(16), 1.0, 0, b"x")], ORIGIN)
    single = frame.encode_request(bytes(16), 1.0, ORIGIN)
    packed = frame.encode_answer(NO_STAMP, bytes(16), packed=True)
    assert header[:1] == batch_frames.BATCH
    assert batch_frames.BATCH not in (single[:1], packed[:1])
    with pytest.raises(FrameError):
        frame.decode_request(header)
    with pytest.raises(FrameError):
        batch_frames.decode_requests(single, content)
    with pytest.raises(FrameError):
        frame.decode_answer(
            batch_frames.encode_answers(NO_STAMP, [(bytes(16), NO_LOAD, b"", "")])[0]
        )


@given(requests, st.data())
def test_a_batch_that_is_cut_is_refused_as_a_whole(
    sent: list[tuple[bytes, float, Handling, bytes]], data: st.DataObject
) -> None:
    """Unless the cut falls between two requests: then the first ones are whole."""
    header, content = batch_frames.encode_requests(sent, ORIGIN)
    ends = [0]
    for *_, payload in sent:
        ends.append(ends[-1] + 16 + 8 + 1 + 4 + len(payload))
    at = data.draw(st.integers(0, len(content) - 1))
    if at and at in ends:
        assert len(batch_frames.decode_requests(header, content[:at])) == ends.index(at)
        return
    with pytest.raises(FrameError):
        batch_frames.decode_requests(header, content[:at])


@pytest.mark.parametrize("remaining_s", [-1.0, float("nan"), float("inf")])
def test_a_time_that_is_none_is_refused(remaining_s: float) -> None:
    good = (request_id(1), 1.0, 0, b"x")
    batch = batch_frames.encode_requests([good, (request_id(2), remaining_s, 0, b"y")], ORIGIN)
    with pytest.raises(FrameError, match="remaining time"):
        batch_frames.decode_requests(*batch)


def test_there_is_a_limit_to_what_a_batch_may_claim() -> None:
    many = [(request_id(n), NO_LOAD, b"", "") for n in range(batch_frames.LIMIT + 1)]
    with pytest.raises(FrameError, match="more than"):
        batch_frames.decode_answers(*batch_frames.encode_answers(NO_STAMP, many))
    most = batch_frames.encode_answers(NO_STAMP, many[:-1])
    assert len(batch_frames.decode_answers(*most)[1]) == 64


# -- what is held -------------------------------------------------------------------------


@given(
    st.lists(
        st.one_of(st.none(), st.tuples(st.sampled_from(["/a", "/b"]), st.integers(0, 4096))),
        max_size=150,
    )
)
def test_each_leaves_once_in_order_and_fits(steps: list[tuple[str, int] | None]) -> None:
    """None takes what is held; what is in the way of a newcomer leaves before it."""
    held, came, left = BatchBuffer(), [], []
    for number, step in enumerate([*steps, None]):
        if step is None:
            leaving = held.take()
        else:
            service, size = step
            one = OpenAttempt(
                service, request_id(number), bytes(size), size, offered=0.0, deadline=1.0
            )
            came.append(one)
            leaving = held.add(one)
        assert len({one.service for one in leaving}) <= 1
        assert len(leaving) <= batch_frames.LIMIT
        assert sum(one.size for one in leaving) <= batch_frames.BYTES_LIMIT
        left += leaving
    assert left == came
    assert not held.attempts


STREAMS: list[Any] = [object(), object()]


@given(
    st.lists(
        st.one_of(
            st.none(),
            st.tuples(st.integers(0, 1), st.sampled_from([0, 10, 4096, 5000]), st.booleans()),
        ),
        max_size=60,
    )
)
def test_replies_leave_in_order_and_only_those_of_one_query_together(
    plan: list[tuple[int, int, bool] | None],
) -> None:
    """What is large, or may be compressed, leaves alone, as do ends of queries (None here)."""
    queue = ReplyQueue()
    query: Any = object()
    put = [
        QueryEnd(query, lambda: 0)
        if one is None
        else Reply(STREAMS[one[0]], request_id(n), bytes(one[1]), "", may_pack=one[2])
        for n, one in enumerate(plan)
    ]
    for reply in put:
        queue.replies.put(reply)
    queue.replies.put(None)
    found: list[Reply | QueryEnd] = []
    while together := queue.next(1.0):
        if isinstance(together, QueryEnd):
            found.append(together)
            continue
        if len(together) > 1:
            assert len({id(reply.stream) for reply in together}) == 1
            assert all(reply.joins for reply in together)
            assert sum(len(r.payload) for r in together) <= batch_frames.BYTES_LIMIT
            assert len(together) <= batch_frames.LIMIT
        found += together
    assert found == put
    with pytest.raises(Empty):
        queue.next(0.0)


class _Stalled:
    """A stream of a robot that reads when it is let."""

    def __init__(self) -> None:
        self.reads = threading.Event()

    def send_at_once(self, send: Callable[[bytes], None]) -> bool:
        return False

    def send(self, send: Callable[[bytes], None]) -> None:
        self.reads.wait(10.0)


def test_a_large_reply_passes_beside_small_ones_and_none_of_them_is_dropped() -> None:
    counters, stalled = Counters(), _Stalled()
    stream: Any = stalled
    queues = ReplyQueues(counters)

    def put(n: int, size: int) -> None:
        queues.put(b"token", "robot", Reply(stream, request_id(n), bytes(size), ""), more=True)

    put(0, 1)
    put(1, REPLY_BYTES_LIMIT + 1)
    put(2, 1)
    assert counters.snapshot() == {"replies": 3}
    put(3, SMALL_BYTES + 1)
    assert counters.snapshot() == {"replies": 3, "reply_dropped": 1}
    stalled.reads.set()
    queues.close(10.0)


# -- over Zenoh ---------------------------------------------------------------------------


@pytest.fixture
def arrived() -> list[Incoming]:
    return []


@pytest.fixture
def listener(authority: Authority, arrived: list[Incoming]) -> Iterator[ZenohListener]:
    listener = ZenohListener("127.0.0.1:0", authority.replica(), ReplicaId(POOL_UID, 0, 1))

    def answer_probe(probe: Probe) -> ProbeAnswer:
        return ProbeAnswer(slot=0, generation=1, incarnation="here", ready=frozenset({SERVICE}))

    listener.serve(keys(0), arrived.append, answer_probe)
    yield listener
    listener.close()


@pytest.fixture
def link(listener: ZenohListener, dial: Callable[..., ZenohLink]) -> ZenohLink:
    link = dial(listener.endpoint)
    wait_for(lambda: link.usable)
    return link


def spy(monkeypatch: pytest.MonkeyPatch, name: str) -> list[int]:
    """Note how many went into each batch of a kind."""
    sizes: list[int] = []
    encode = getattr(batch_frames, name)

    def noted(*given: Any, **named: Any) -> Any:
        sizes.extend(len(parts) for parts in given if isinstance(parts, list))
        return encode(*given, **named)

    monkeypatch.setattr(batch_frames, name, noted)
    return sizes


def test_what_is_offered_with_more_leaves_in_one_message_and_each_is_answered(
    link: ZenohLink, owner: Owner, arrived: list[Incoming], monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes = spy(monkeypatch, "encode_requests")
    for number in range(10):
        assert link.offer(SERVICE, request_id(number), b"%d" % number, 30.0, more=True)
    assert not arrived
    link.send()
    wait_for(lambda: len(arrived) == 10)
    assert sizes == [10]
    assert [one.payload for one in arrived] == [b"%d" % number for number in range(10)]
    for one in reversed(arrived):
        one.reply(b"to " + one.payload)
    wait_for(lambda: len(owner.answers) == 10)
    for number in range(10):
        assert [answer.payload for answer in owner.of(number)] == [b"to %d" % number]


def test_an_offer_without_more_takes_along_what_is_held(
    link: ZenohLink, arrived: list[Incoming]
) -> None:
    assert link.offer(SERVICE, request_id(1), b"1", 30.0, more=True)
    assert link.offer(SERVICE, request_id(2), b"2", 30.0)
    wait_for(lambda: len(arrived) == 2)
    assert [one.payload for one in arrived] == [b"1", b"2"]


def test_what_is_large_overtakes_nothing_that_is_held(
    link: ZenohLink, arrived: list[Incoming]
) -> None:
    """It goes to the sender thread, and what was held leaves before it gets there."""
    assert link.offer(SERVICE, request_id(1), b"1", 30.0, more=True)
    assert link.offer(SERVICE, request_id(2), bytes(1 << 20), 30.0, more=True)
    wait_for(lambda: len(arrived) == 2)
    assert [len(one.payload) for one in arrived] == [1, 1 << 20]


def test_flush_sends_what_nobody_sent(link: ZenohLink, arrived: list[Incoming]) -> None:
    """Whoever forgets `send` loses a moment, and no request."""
    assert link.offer(SERVICE, request_id(1), b"1", 30.0, more=True)
    link.flush()
    wait_for(lambda: len(arrived) == 1)


def test_what_is_forgotten_while_it_is_held_is_not_sent(
    link: ZenohLink, arrived: list[Incoming]
) -> None:
    for number in range(3):
        assert link.offer(SERVICE, request_id(number), b"%d" % number, 30.0, more=True)
    link.forget(request_id(1))
    link.send()
    wait_for(lambda: len(arrived) == 2)
    assert [one.payload for one in arrived] == [b"0", b"2"]


def test_what_is_held_as_the_link_closes_ends_once(
    link: ZenohLink, owner: Owner, arrived: list[Incoming]
) -> None:
    for number in range(3):
        assert link.offer(SERVICE, request_id(number), b"x", 30.0, more=True)
    link.close()
    link.send()
    assert [answer.refusal for _, answer in owner.answers] == [Refusal.LOST] * 3
    assert not arrived


def test_refusals_and_answers_share_a_message_and_stay_apart(
    link: ZenohLink, owner: Owner, arrived: list[Incoming], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever comes together: each request gets what was said to it."""
    sizes = spy(monkeypatch, "encode_answers")
    for round in range(20):  # the reply thread takes what waits: nearly always several
        first = round * 10
        for number in range(first, first + 10):
            assert link.offer(SERVICE, request_id(number), b"%d" % number, 30.0, more=True)
        link.send()
        wait_for(lambda first=first: len(arrived) == first + 10)  # type: ignore[misc]
        for one in arrived[first:]:
            if int(one.payload) % 3:
                one.reply(one.payload)
            else:
                one.refuse(Refusal.OVERLOADED)
        wait_for(lambda first=first: len(owner.answers) == first + 10)  # type: ignore[misc]
    for number in range(200):
        (answer,) = owner.of(number)
        assert (answer.payload, answer.refusal) == (
            (b"%d" % number, None) if number % 3 else (None, Refusal.OVERLOADED)
        )
    assert sizes
    assert max(sizes) > 1


def test_one_that_is_not_taken_does_not_take_the_others_with_it(
    authority: Authority, dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """At either end: an error of whoever takes it is logged, and ends that one only."""
    taken, told = [], owner.answered

    def take(incoming: Incoming) -> None:
        if incoming.payload == b"1":
            raise RuntimeError("of the proxy")
        taken.append(incoming)

    def hear(link: Any, answer: Any) -> None:
        if answer.request_id == request_id(2):
            raise RuntimeError("of the robot")
        told(link, answer)

    owner.answered = hear  # type: ignore[method-assign]
    listener = ZenohListener("127.0.0.1:0", authority.replica(), ReplicaId(POOL_UID, 0, 1))
    listener.serve(
        keys(0),
        take,
        lambda probe: ProbeAnswer(
            slot=0, generation=1, incarnation="i", ready=frozenset({SERVICE})
        ),
    )
    try:
        link = dial(listener.endpoint)
        wait_for(lambda: link.usable)
        for number in range(5):
            assert link.offer(SERVICE, request_id(number), b"%d" % number, 60.0, more=True)
        link.send()
        wait_for(lambda: len(taken) == 4)
        for one in taken:
            one.reply(one.payload)
        wait_for(lambda: all(owner.of(number) for number in (0, 1, 3, 4)))
        assert [owner.of(n)[0].payload for n in (0, 3, 4)] == [b"0", b"3", b"4"]
        assert owner.of(1)[0].refusal == Refusal.LOST
        assert listener.counters().get("failed") == 1
        assert link.status().reopened == 0
    finally:
        listener.close()


def test_a_batch_of_a_stranger_or_of_garbage_is_not_taken(
    authority: Authority, listener: ZenohListener, arrived: list[Incoming]
) -> None:
    """The same door as for single requests, and each is counted."""
    settings = config.robot_settings(
        peer(listener.endpoint), authority.robot("eve"), LinkSettings()
    )
    session = zenoh.open(config.to_zenoh(settings))
    try:
        key = keys(0)[SERVICE]
        hears(session, key)
        header, content = batch_frames.encode_requests([(request_id(1), 5.0, 0, b"x")] * 3, ORIGIN)
        session.put(key, content, attachment=header)
        wait_for(lambda: listener.counters().get("not_admitted") == 1)
        wait_for(lambda: listener.counters().get("requests") == 3)
        for said, attached in ((content[:-1], header), (b"", header), (content, header[:5])):
            session.put(key, said, attachment=attached)
        wait_for(lambda: listener.counters().get("malformed") == 3)
    finally:
        session.close()
    assert not arrived
