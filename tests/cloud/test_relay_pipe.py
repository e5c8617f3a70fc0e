"""The arithmetic of a slow path, and that no fault ever changes a byte."""

from __future__ import annotations

import socket

from hypothesis import given, settings
from hypothesis import strategies as st

from fogft.cloud.local.relay_pipe import MAX_HELD_BYTES, Pipe, Shaper
from tests.nightly import by_day


def test_a_chunk_takes_its_size_over_the_rate_after_those_before_it_and_then_the_delay():
    shaper = Shaper()
    shaper.set(delay_s=1.0, rate_bytes_per_s=100.0)
    assert [shaper.arrival(50, now=10.0), shaper.arrival(50, now=10.0)] == [11.5, 12.0]
    assert shaper.arrival(100, now=20.0) == 22.0, "an idle path does not save up"


def test_a_path_without_a_rate_delays_all_alike():
    shaper = Shaper()
    shaper.set(delay_s=0.5, rate_bytes_per_s=None)
    assert shaper.arrival(1 << 30, now=1.0) == 1.5
    assert not shaper.transparent
    shaper.set(0.0, None)
    assert shaper.transparent


@given(st.floats(1, 1e9), st.floats(0, 100))
def test_a_slow_path_holds_no_more_than_it_carries(rate, delay_s):
    shaper = Shaper()
    shaper.set(delay_s, rate)
    assert 1024 <= shaper.chunk_bytes <= max(1024, rate * 0.02 + 1)
    assert shaper.room_bytes <= min(MAX_HELD_BYTES, rate * (delay_s + 0.02) + (64 << 10) + 1)


faults = st.tuples(st.sampled_from([0.0, 0.5, 2.0]), st.sampled_from([None, 500.0, 1e6]))
steps = st.lists(
    st.one_of(
        st.tuples(st.just("send"), st.binary(min_size=1, max_size=3000)),
        st.tuples(st.just("pass"), st.sampled_from([0.0, 0.1, 1.0])),
        st.tuples(st.just("set"), faults),
    ),
    max_size=30,
)


@settings(deadline=None, max_examples=by_day(40, at_night=1000))
@given(steps)
def test_whatever_the_path_does_every_byte_arrives_once_and_in_order(script):
    """Delays and rates change at any time; the bytes do not."""
    here, source = socket.socketpair()
    target, there = socket.socketpair()
    with here, source, target, there:
        for sock in (source, target, there):
            sock.setblocking(False)
        shaper = Shaper()
        pipe = Pipe(source, target, shaper)
        buffer, now, sent, received = memoryview(bytearray(1 << 16)), 0.0, b"", b""

        def take() -> bytes:
            try:
                return there.recv(1 << 20)
            except BlockingIOError:
                return b""

        for what, value in script:
            if what == "send":
                here.sendall(value)
                sent += value
            elif what == "set":
                shaper.set(*value)
            else:
                now += value
            pipe.pump(buffer, now)
            pipe.flush(now)
            received += take()
            assert sent.startswith(received)
        here.shutdown(socket.SHUT_WR)
        for _ in range(2000):
            if pipe.done:
                break
            now += 10.0
            pipe.pump(buffer, now)
            pipe.flush(now)
            received += take()
        received += take()
        assert received == sent
        assert pipe.done
        assert (pipe.held_bytes, shaper.held) == (0, 0)
