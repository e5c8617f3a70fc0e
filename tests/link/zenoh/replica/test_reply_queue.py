"""The queues of replies, without Zenoh: what is sent by which thread, and what an error costs."""

from __future__ import annotations

import threading
from typing import Any, cast

import pytest

from fogft.counters import Counters
from fogft.link.zenoh.replica import reply_queue
from fogft.link.zenoh.replica.reply_queue import ReplyQueues
from tests.fakes.threads import no_more
from tests.link.wire_pool import wait_for


class Stream:
    """Takes what is sent with patience only."""

    def send_at_once(self, send: object) -> bool:
        return False

    def send(self, send: Any) -> None:
        send(b"stamp")


class Reply:
    """A small reply."""

    joins = True
    may_pack = False
    refusal = payload = b""

    def __init__(self) -> None:
        self.stream = Stream()


def test_a_thread_that_cannot_be_started_costs_only_the_reply_it_was_for(monkeypatch):
    queues = ReplyQueues(Counters())
    queues.idle_s = 0.01
    sent: list[Any] = []
    monkeypatch.setattr(reply_queue, "send_together", lambda replies, stamp: sent.extend(replies))
    lost, reply = cast("Any", Reply()), cast("Any", Reply())
    with no_more(), pytest.raises(OSError, match="thread"):
        queues.put(b"token", "robot", lost, more=True)
    assert len(queues) == 0
    queues.put(b"token", "robot", reply, more=True)
    wait_for(lambda: sent == [reply])
    wait_for(lambda: len(queues) == 0)


def test_a_robot_that_reads_slowly_has_so_many_refusals_waiting_and_no_more(monkeypatch):
    queues, go_on = ReplyQueues(Counters()), threading.Event()
    sent: list[Any] = []

    def send(replies: list[Any], stamp: bytes) -> None:
        go_on.wait(10.0)
        sent.extend(replies)

    monkeypatch.setattr(reply_queue, "send_together", send)
    for _ in range(20_000):
        queues.put(b"token", "eve", cast("Any", Reply()), more=True)
    go_on.set()
    wait_for(lambda: len(sent) >= 4096)
    ours = cast("Any", Reply())
    queues.put(b"other", "ann", ours, more=True)
    wait_for(lambda: ours in sent)
    assert len(sent) < 5000


def test_a_reply_that_is_larger_than_its_robot_takes_is_refused_for_good(monkeypatch):
    monkeypatch.setattr(reply_queue, "MESSAGE_BYTES_LIMIT", 10_000)
    queues, sent = ReplyQueues(Counters()), []
    monkeypatch.setattr(reply_queue, "send_together", lambda replies, stamp: sent.extend(replies))
    reply = cast("Any", Reply())
    reply.payload = bytes(9_000)
    queues.put(b"token", "robot", reply, more=True)
    wait_for(lambda: sent == [reply])
    assert (reply.payload, reply.refusal) == (b"", "malformed:too large")
