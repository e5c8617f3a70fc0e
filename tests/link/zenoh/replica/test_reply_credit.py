"""What may leave at once to a robot: only what cannot block, whatever it says and has."""

from __future__ import annotations

import threading
import weakref
from typing import Any, cast

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from fogft.counters import Counters
from fogft.link import frame
from fogft.link.zenoh.replica.reply_queue import ReplyQueues, ZenohIncoming
from fogft.link.zenoh.replica.reply_streams import CREDIT_LIMIT, ReplyCredit, Streams
from tests.fakes.proxy import Clock

ONE, OTHER = object(), object()  # two connections of a robot


@given(
    st.lists(
        st.one_of(
            st.sampled_from(["at once", "with patience", "forged"]),
            st.integers(0, 40),  # the robot has seen the reply of this number, if it was sent
        )
    )
)
def test_only_what_cannot_block_leaves_at_once(steps: list[str | int]) -> None:
    """At most so much on the way, by what the robot proves; nothing behind what may be stuck."""
    credit, sent, seen, patient = ReplyCredit(), [], 0, 0
    for step in steps:
        if step == "at once":
            left = credit.send_at_once(ONE, sent.append)
            assert left == (len(sent) - left - seen < CREDIT_LIMIT and patient <= seen)
        elif step == "with patience":
            credit.send(ONE, sent.append)
            patient = len(sent)
        elif step == "forged":
            credit.seen(ONE, frame.NO_STAMP)
        elif isinstance(step, int) and step < len(sent):
            credit.seen(ONE, sent[step])
            if step + 1 >= patient:  # older ones say nothing of what was sent with patience
                seen = max(seen, step + 1)
    assert len(set(sent)) == len(sent)


def test_nothing_leaves_at_once_while_somebody_sends_who_may_block() -> None:
    credit, tried = ReplyCredit(), []
    credit.send(ONE, lambda _: tried.append(credit.send_at_once(ONE, tried.append)))
    assert tried == [False]
    assert not credit.send_at_once(ONE, tried.append)  # nor before the robot has seen that one


def test_whoever_sends_with_patience_goes_on_after_an_error() -> None:
    credit = ReplyCredit()

    def fail(_: bytes) -> None:
        raise zenoh.ZError("closed")

    for send in (credit.send_at_once, credit.send):
        with pytest.raises(zenoh.ZError):
            send(ONE, fail)
    sent: list[bytes] = []
    credit.send(ONE, sent.append)
    assert len(sent) == 1


def test_what_is_sent_with_patience_while_a_stamp_is_looked_up_is_not_taken_for_seen() -> None:
    credit, sent = ReplyCredit(), []
    credit.send_at_once(ONE, sent.append)

    class Raced(bytes):
        """Somebody else is faster, once, while this is looked up."""

        def __hash__(self) -> int:
            if len(sent) == 1:
                credit.send(ONE, sent.append)
            return super().__hash__()

    credit.seen(ONE, Raced(sent[0]))
    assert len(sent) == 2
    assert not credit.send_at_once(ONE, sent.append)
    credit.seen(ONE, sent[1])
    assert credit.send_at_once(ONE, sent.append)


def test_all_connections_of_a_robot_count_together() -> None:
    """They may share one socket: together they would fill what it holds."""
    credit, sent = ReplyCredit(), []
    for connection in (ONE, OTHER, ONE, OTHER):
        assert credit.send_at_once(connection, sent.append)
    assert not credit.send_at_once(ONE, sent.append)
    credit.seen(OTHER, sent[2])  # it was sent on the other one: that says nothing of this
    assert not credit.send_at_once(ONE, sent.append)
    credit.seen(ONE, sent[2])
    assert credit.send_at_once(OTHER, sent.append)
    credit.send(OTHER, sent.append)
    assert not credit.send_at_once(ONE, sent.append)


def test_nothing_leaves_at_once_beside_one_who_may_block_on_another_connection() -> None:
    """However long he is at it; and whoever sends so does not wait for the next one."""
    clock, tried = Clock(), []
    credit = ReplyCredit(clock=clock)

    def long(_: bytes) -> None:
        clock.now += 3600.0
        tried.append(credit.send_at_once(ONE, tried.append))
        credit.send(ONE, lambda stamp: credit.seen(ONE, stamp))

    credit.send(OTHER, long)
    tried.append(credit.send_at_once(ONE, tried.append))
    assert tried == [False, False]


def test_what_was_sent_on_another_connection_counts_for_a_minute() -> None:
    """That may be gone: a robot opens a new one where the old one is lost."""
    clock, sent = Clock(), []
    credit = ReplyCredit(clock=clock)
    credit.send(OTHER, sent.append)
    clock.now += 59.0
    assert not credit.send_at_once(ONE, sent.append)
    clock.now += 2.0
    assert credit.send_at_once(ONE, sent.append)
    clock.now += 3600.0
    credit.send(ONE, sent.append)
    clock.now += 3600.0
    assert not credit.send_at_once(ONE, sent.append), "its own must be seen"


def test_connections_that_are_gone_leave_nothing_behind() -> None:
    clock = Clock()
    credit = ReplyCredit(clock=clock)
    seen = []
    for _ in range(1000):
        connection = threading.Event()
        seen.append(weakref.ref(connection))
        credit.send(connection, lambda _: None)
        clock.now += 1.0
    assert sum(one() is not None for one in seen) < 70


def test_who_reads_slowly_is_sent_nothing_at_once() -> None:
    """Their replies leave by threads that may block."""
    senders: dict[bytes, threading.Thread] = {}

    class Query:
        key_expr = "a"

        def reply(self, key: str, payload: bytes, *, attachment: bytes) -> None:
            senders[payload] = threading.current_thread()

    streams, queues = Streams(slow={"a"}.__contains__), ReplyQueues(Counters())
    for token, holder in ((b"1" * 8, "a"), (b"2" * 8, "b")):
        streams.opened(token, cast("Any", Query()), holder)
        stream = streams.of(token)
        assert stream is not None
        header = frame.RequestHeader(bytes(16), 1.0, token, holder)
        ZenohIncoming("/s", header, b"", stream, queues).reply(holder.encode())
    queues.close(5.0)
    assert senders[b"a"] is not senders[b"b"] is threading.current_thread()


def test_only_the_connections_of_one_robot_count_together() -> None:
    streams = Streams()
    for token, holder in ((b"1", "a"), (b"2", "a"), (b"3", "b")):
        streams.opened(token, None, holder)
    first, second, other = (streams.of(token) for token in (b"1", b"2", b"3"))
    assert first is not None
    first.send(lambda _: None)
    assert second is not None
    assert not second.send_at_once(lambda _: None)
    assert other is not None
    assert other.send_at_once(lambda _: None)
