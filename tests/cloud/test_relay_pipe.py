"""The arithmetic of a slow path, and that no fault ever changes a byte."""

from __future__ import annotations

import select
import socket

from hypothesis import given, settings
from hypothesis import strategies as st

from fogft.cloud.local.faults import LinkFaults
from fogft.cloud.local.relay import MAX_HELD_BYTES, Relay, Shaper
from tests.cloud.held import held_bytes
from tests.nightly import by_day


def test_a_chunk_takes_its_size_over_the_rate_after_those_before_it_and_then_the_delay():
    shaper = Shaper()
    shaper.delay_s, shaper.rate = 1.0, 100.0
    assert [shaper.arrival(50, now=10.0), shaper.arrival(50, now=10.0)] == [11.5, 12.0]
    assert shaper.arrival(100, now=20.0) == 22.0, "an idle path does not save up"


def test_a_path_without_a_rate_delays_all_alike():
    shaper = Shaper()
    shaper.delay_s = 0.5
    assert shaper.arrival(1 << 30, now=1.0) == 1.5
    shaper.delay_s = 0.0
    assert (shaper.arrival(1 << 30, now=1.0), shaper.room_bytes) == (1.0, 0)


@given(st.floats(1, 1e9), st.floats(0, 100))
def test_a_slow_path_holds_no_more_than_it_carries(rate, delay_s):
    shaper = Shaper()
    shaper.delay_s, shaper.rate = delay_s, rate
    assert 1024 <= shaper.chunk_bytes <= max(1024, rate * 0.02 + 1)
    assert shaper.room_bytes <= min(MAX_HELD_BYTES, rate * (delay_s + 0.02) + (64 << 10) + 1)


faults = st.builds(
    LinkFaults,
    delay_s=st.sampled_from([0.0, 0.001, 0.004]),
    rate_bytes_per_s=st.sampled_from([None, 500_000.0, 1e7]),
    blackhole=st.booleans(),
)
steps = st.lists(
    st.one_of(st.binary(min_size=1, max_size=3000), st.sampled_from([0.0, 0.002]), faults),
    max_size=30,
)


@settings(deadline=None, max_examples=by_day(40, at_night=1000))
@given(steps)
def test_whatever_the_path_does_every_byte_arrives_once_and_in_order(script):
    """Delays, rates and blackholes come at any time; the bytes do not change."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        relay = Relay(server.getsockname())
        here = socket.create_connection(relay.endpoint.split(":"))
        while not select.select([server], [], [], 0)[0]:
            relay.step(0.001)
        there, _ = server.accept()
        there.setblocking(False)
        sent, received = b"", b""

        def take() -> bytes:
            try:
                return there.recv(1 << 20)
            except BlockingIOError:
                return b""

        for what in script:
            if isinstance(what, bytes):
                here.sendall(what)
                sent += what
            elif isinstance(what, LinkFaults):
                relay.set_faults(what)
            else:
                relay.step(what)
            received += take()
            assert sent.startswith(received)
        here.shutdown(socket.SHUT_WR)
        relay.set_faults(LinkFaults())
        for _ in range(2000):
            if received == sent and held_bytes(relay) == 0:
                break
            relay.step(0.001)
            received += take()
        assert received == sent
        there.close()
        for _ in range(2000):
            if not relay.connections:
                break
            relay.step(0.001)
        assert (held_bytes(relay), len(relay.connections)) == (0, 0)
        here.close()
        relay.close()
