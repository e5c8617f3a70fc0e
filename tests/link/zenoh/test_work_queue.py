"""The worker thread: it does what it takes, in order, whatever one of them does."""

from __future__ import annotations

import logging
import threading
from functools import partial

from fogft.counters import Counters
from fogft.link.zenoh.work_queue import LANES_LIMIT, LIMIT, WorkQueue
from tests.link.wire_pool import LIMIT_S, wait_for


def test_jobs_are_done_in_order_and_one_that_fails_stops_none(caplog):
    counters, done, last = Counters(), [], threading.Event()
    work = WorkQueue("test", counters)
    work.add(lambda: done.append(1))
    work.start()
    work.add(lambda: done.append(1 // 0))
    assert work.offer(lambda: done.append(2))
    work.add(last.set)
    assert last.wait(LIMIT_S)
    work.close()
    assert done == [1, 2]
    assert counters.snapshot() == {"failed": 1}
    assert "ZeroDivisionError" in caplog.text


def test_only_so_many_wait_but_what_must_be_taken_is():
    counters, done = Counters(), []
    work = WorkQueue("test", counters)
    assert all(work.offer(partial(done.append, one)) for one in range(LIMIT))
    assert not work.offer(print)
    work.add(partial(done.append, "taken"))
    assert counters.snapshot() == {"control_queries_dropped": 1}
    work.start()
    work.close()
    work.join(LIMIT_S)
    assert done == [0, "taken", *range(1, LIMIT)]


def test_who_gives_many_jobs_waits_for_himself():
    """A lane that is full keeps no other out, and the lanes take turns."""
    work, done = WorkQueue("test", Counters()), []
    while work.offer(lambda: done.append("eve"), b"eve"):
        pass
    assert work.offer(lambda: done.append("ada"), b"ada")
    work.start()
    wait_for(lambda: len(done) == LIMIT + 1)
    assert done[:3] == ["eve", "ada", "eve"]


def test_only_so_many_may_give_jobs():
    counters = Counters()
    work = WorkQueue("test", counters)
    assert all(work.offer(print, b"%d" % one) for one in range(LANES_LIMIT))
    assert not work.offer(print, b"another")
    assert work.offer(print, b"of one who is let in", always=True)
    assert counters.snapshot() == {"control_queries_dropped": 1}


def test_what_happens_often_is_logged_seldom(caplog):
    counters, log = Counters(), logging.getLogger("test")
    for number in range(9):
        counters.warn(log, "odd", "it_was_odd number=%d", number)
    assert counters.add("odd", 2) == 11
    assert [record.getMessage() for record in caplog.records] == [
        f"it_was_odd number={count - 1} count={count}" for count in (1, 2, 4, 8)
    ]
