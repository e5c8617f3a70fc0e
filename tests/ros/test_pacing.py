"""No client gets more responses than an ordinary one keeps, unless it shows that it takes them."""

from __future__ import annotations

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.errors import RosError
from fogft.ros.pacing import (
    EVERY_S,
    WAITING_BYTES_LIMIT,
    WAITING_LIMIT,
    WINDOW,
    WINDOW_LIMIT,
    Pace,
    Pacer,
)
from fogft.ros.port import NotFoundYet

ORDINARY = 10  # responses that a client with the default quality of service keeps


def test_a_burst_is_answered_a_window_at_once_and_then_one_by_one():
    pace = Pace(0.0)
    for n in range(200):
        pace.requested(n * 1e-5)
    now, sent = 0.002, 0
    while sent < 200:
        sent += pace.take(now)
        assert sent <= WINDOW + (now - 0.002) / EVERY_S + 1
        now += 1e-4
    assert now < 200 * EVERY_S


@given(
    bursts=st.lists(st.integers(1, 200), min_size=1, max_size=6),
    pauses=st.sampled_from([0.0, 0.01, 0.3]),
    latency=st.floats(0.002, 0.01),
    spacing=st.floats(2e-5, 2e-4),
)
def test_a_client_that_takes_nothing_while_it_asks_never_overflows(
    bursts, pauses, latency, spacing
):
    """It asks in bursts and takes one a millisecond otherwise; answers come slower than it asks."""
    now, pace, untaken = 0.0, Pace(0.0), 0
    asked: list[float] = []

    def answer(most: int = 1000) -> int:
        sent = 0
        while sent < most and asked and asked[0] + latency <= now and pace.take(now):
            asked.pop(0)
            sent += 1
        return sent

    for burst in bursts:
        for n in range(burst):
            pace.requested(now)
            asked.append(now)
            now += spacing
            if n % 2:
                untaken += answer(1)
            assert untaken <= ORDINARY
        while asked or untaken:
            untaken = max(untaken - 1, 0)
            now += 0.001
            untaken += answer()
            assert untaken <= ORDINARY
        now += pauses


@pytest.mark.parametrize("at_once", [1, 2, 9, 64])
def test_a_client_that_asks_again_for_each_answer_is_hardly_held_up(at_once):
    """A caller in a closed loop, however fast, waits only until what it has open is usual."""
    now, pace, waits = 0.0, Pace(0.0), 0
    for _ in range(at_once):
        pace.requested(now)
    for _ in range(5000):
        while not pace.take(now):
            waits += 1
            now += EVERY_S
        now += 1e-5
        pace.requested(now)
    assert waits <= at_once


def test_a_client_that_proved_quick_must_prove_it_again_after_a_pause():
    pace = Pace(0.0)
    now = 0.0
    for _ in range(1000):
        pace.requested(now)
        assert pace.take(now)
        now += 1e-4
    now += 1.0
    for _ in range(2 * WINDOW_LIMIT):
        pace.requested(now)
    assert sum(pace.take(now) for _ in range(2 * WINDOW_LIMIT)) == WINDOW


def test_a_client_that_asks_more_than_is_answered_is_not_starved():
    """It asks five thousand times a second for long, and takes: that is no burst, but its use."""
    now, pace, sent = 0.0, Pace(0.0), 0
    for n in range(10_000):
        pace.requested(now)
        now += 2e-4
        if n % 5 < 3:  # what the replicas can answer
            sent += pace.take(now)
    assert sent > 5000


class Sent:
    def __init__(self) -> None:
        self.responses: list[tuple[bytes, bytes]] = []
        self.all = threading.Event()
        self.expected = 0

    def __call__(self, handle: bytes, payload: bytes) -> None:
        if payload == b"refused":
            raise RosError("no room")
        self.responses.append((handle, payload))
        if len(self.responses) == self.expected:
            self.all.set()


def handle(client: int, number: int) -> bytes:
    return bytes([client]) * 16 + number.to_bytes(8, "little")


def test_every_response_is_sent_once_and_in_order():
    sent = Sent()
    sent.expected = 99
    pacer = Pacer(sent)
    for n in range(100):
        pacer.requested(handle(1, n))
    for n in range(100):
        pacer.respond(handle(1, n), b"refused" if n == 50 else b"%d" % n)
    assert sent.all.wait(30)
    assert sent.responses == [(handle(1, n), b"%d" % n) for n in range(100) if n != 50]
    pacer.close()


@pytest.mark.parametrize(("size", "most"), [(0, WAITING_LIMIT), (1 << 20, 64)])
def test_what_waits_for_one_client_is_bounded(size, most):
    """Beyond that it is sent at once: nothing is kept without end, and nothing is dropped."""
    sent = []
    pacer = Pacer(lambda handle, payload: sent.append(handle), clock=lambda: 0.0)
    payload = bytes(size)
    asked = [handle(0, number) for number in range(WINDOW + most + 100)]
    for one in asked:
        pacer.requested(one)
    for one in asked:
        pacer.respond(one, payload)
    pacer.close()
    assert len(sent) == WINDOW + 100
    assert WAITING_BYTES_LIMIT == 64 << 20


def test_one_clients_burst_does_not_hold_up_another():
    sent = Sent()
    pacer = Pacer(sent, clock=lambda: 0.0)
    for n in range(100):
        pacer.requested(handle(1, n))
        pacer.respond(handle(1, n), b"")
    pacer.requested(handle(2, 0))
    pacer.respond(handle(2, 0), b"")
    assert sent.responses[-1][0] == handle(2, 0)
    pacer.close()


def test_clients_that_are_gone_are_forgotten():
    pacer = Pacer(lambda handle, payload: None)
    for client in range(200):
        pacer.requested(handle(client, 0))
        pacer.respond(handle(client, 0), b"")
    assert pacer.clients <= 64
    pacer.close()


def test_a_response_to_a_client_that_is_not_found_yet_is_sent_again():
    """Once and no more, when discovery has told the way to it; others are not held up."""
    sent: list[bytes] = []
    tries: list[bytes] = []
    found = threading.Event()

    def send(handle: bytes, payload: bytes) -> None:
        tries.append(payload)
        if payload == b"early" and len(tries) < 4:
            raise NotFoundYet("client will not receive response")
        sent.append(payload)
        if payload == b"early":
            found.set()

    pacer = Pacer(send)
    pacer.respond(bytes(24), b"early")
    pacer.respond(bytes(range(24)), b"other")
    assert found.wait(30)
    pacer.close()
    assert sorted(sent) == [b"early", b"other"]


def test_a_client_that_is_never_found_is_given_up():
    """And whoever wants to know is told."""
    now = 0.0

    def send(handle: bytes, payload: bytes) -> None:
        nonlocal now
        now += 1.0
        raise NotFoundYet("client will not receive response")

    pacer = Pacer(send, clock=lambda: now)
    with pytest.raises(NotFoundYet):
        pacer.try_now(bytes(24), b"early", 0.5)
