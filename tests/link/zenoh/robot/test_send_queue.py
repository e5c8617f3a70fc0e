"""What waits for a sender: nothing is lost, and of some services the newest goes first."""

from __future__ import annotations

import threading

from hypothesis import given
from hypothesis import strategies as st

from fogft.link.window import OpenAttempt, SendQueue


def attempt(service: str, born: float, number: int = 0) -> OpenAttempt:
    id = number.to_bytes(16, "big")
    return OpenAttempt(service, id, b"payload", 7, offered=born, deadline=born + 10.0)


def taken(queue: SendQueue) -> list[OpenAttempt]:
    queue.put(None)
    return list(iter(queue.get, None))


@given(st.lists(st.tuples(st.sampled_from(["/every", "/latest", "/scan"]), st.integers(0, 9))))
def test_each_service_has_its_turns_and_its_own_order(asked):
    """As many turns as requests, in the order of arrival; the newest first where wanted."""
    queue = SendQueue({"/latest"})
    attempts = [attempt(service, born, n) for n, (service, born) in enumerate(asked)]
    for one in attempts:
        queue.put(one)
    found = taken(queue)
    assert [one.service for one in found] == [service for service, _ in asked]
    for service in ("/every", "/scan"):
        of = [one for one in attempts if one.service == service]
        assert [one for one in found if one.service == service] == of
    born = [one.offered for one in found if one.service == "/latest"]
    assert born == sorted(born, reverse=True)


def test_what_gives_way_is_the_oldest_that_was_not_sent_and_never_a_newer_one():
    queue = SendQueue({"/latest"})
    oldest, middle = attempt("/latest", 1.0, 1), attempt("/latest", 2.0, 2)
    queue.put(middle)
    queue.put(oldest)
    assert queue.stalest(attempt("/latest", 3.0, 3)) is oldest
    assert queue.stalest(attempt("/latest", 0.5, 3)) is None
    oldest.payload = None  # it has ended
    assert queue.stalest(attempt("/latest", 3.0, 3)) is middle
    assert queue.stalest(attempt("/every", 3.0, 3)) is None


def test_threads_lose_nothing():
    queue = SendQueue({"/latest"})
    threads = [
        threading.Thread(
            target=lambda t=t: [queue.put(attempt("/latest", n, t * 500 + n)) for n in range(500)]
        )
        for t in range(4)
    ]
    for thread in threads:
        thread.start()
    found = {queue.get().request_id for _ in range(2000)}
    assert len(found) == 2000
    for thread in threads:
        thread.join()
