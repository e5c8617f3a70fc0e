"""The worker thread: it does what it takes, in order, whatever one of them does."""

from __future__ import annotations

import logging
import threading

from fogft.link.counters import Counters
from fogft.link.zenoh.work_queue import LIMIT, WorkQueue
from tests.link.wire_pool import LIMIT_S


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
    counters = Counters()
    work = WorkQueue("test", counters)
    assert all(work.offer(print) for _ in range(LIMIT))
    assert not work.offer(print)
    work.add(print)
    assert len(work) == LIMIT + 1
    assert counters.snapshot() == {"control_queries_dropped": 1}


def test_what_happens_often_is_logged_seldom(caplog):
    counters, log = Counters(), logging.getLogger("test")
    for number in range(9):
        counters.warn(log, "odd", "it_was_odd number=%d", number)
    assert counters.add("odd", 2) == 11
    assert [record.getMessage() for record in caplog.records] == [
        f"it_was_odd number={count - 1} count={count}" for count in (1, 2, 4, 8)
    ]
