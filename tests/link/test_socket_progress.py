"""What counts as flowing, as standing still, and how fast: by numbers, without any socket."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fogft.link.socket_progress import BULK_BYTES, Flow, SocketProgress

rates = st.floats(5e3, 1e7)
intervals = st.lists(st.floats(0.06, 1.0), min_size=2, max_size=30)
TIMES = {"shortest_s": 1.0, "longest_s": 2.0}


def queue(drain: SocketProgress, rate: float, steps: list[float]) -> tuple[float, float, int]:
    """Look at a full queue that drains; return the time, what was excused, and what left."""
    now, acknowledged = 100.0, 0
    excused = drain.look(Flow(0, 0, 10**6), now)
    for step in steps:
        now += step
        acknowledged += int(rate * step)
        excused += drain.look(Flow(acknowledged, 0, 10**6), now)
    return now, excused, acknowledged


@given(rates, intervals)
def test_a_queue_that_drains_is_no_silence_however_slow(rate, steps):
    """All of the time is excused, nothing stalls, and the rate is what was seen."""
    drain = SocketProgress()
    now, excused, _ = queue(drain, rate, steps)
    assert abs(excused - sum(steps)) < 1e-6
    assert not drain.stalled(now, **TIMES)
    assert drain.bytes_per_s is not None
    assert abs(drain.bytes_per_s - rate) <= 1 / min(steps) + rate * 1e-6


@given(rates, intervals, st.floats(0.0, 1.0), st.lists(st.floats(0.06, 0.4), max_size=20))
def test_a_queue_that_stands_still_stalls_after_the_paths_own_pauses(rate, steps, trip_s, waits):
    """Sooner never; and at the latest after `longest_s`."""
    drain = SocketProgress()
    now, _, acknowledged = queue(drain, rate, steps)
    stood = now
    pause_s = min(max(1.0, 4 * trip_s), 2.0)
    for wait in waits:
        now += wait
        assert drain.look(Flow(acknowledged, 0, 10**6, trip_s), now) == 0.0
        if abs(now - stood - pause_s) > 1e-6:
            assert drain.stalled(now, **TIMES) == (now - stood > pause_s)


@given(st.lists(st.integers(0, 2000), min_size=1, max_size=50))
def test_a_frozen_peer_is_not_excused_for_what_its_kernel_takes(sizes):
    """Its kernel acknowledges probes and small requests, which are no queue."""
    drain = SocketProgress()
    now, acknowledged = 5.0, 0
    drain.look(Flow(0, 0, 0), now)
    for size in sizes:
        now += 1.0
        acknowledged += size
        assert drain.look(Flow(acknowledged, 0, min(size, BULK_BYTES - 1)), now) == 0.0
        assert not drain.stalled(now, **TIMES)
    assert drain.bytes_per_s is None


@given(st.lists(st.tuples(st.floats(0.06, 0.5), st.booleans()), min_size=1, max_size=40))
def test_a_queue_that_moves_in_steps_is_excused_in_full_at_each(steps):
    """Up to the last step that was seen; nothing after it."""
    drain, now, acknowledged, excused, moved_at = SocketProgress(), 100.0, 0, 0.0, 100.0
    drain.look(Flow(0, 0, 10**6), now)
    for step, moves in steps:
        now += step
        if moves:
            acknowledged += 30_000
            moved_at = now
        excused += drain.look(Flow(acknowledged, 0, 10**6), now)
    assert abs(excused - (moved_at - 100.0)) < 1e-6


@given(rates, intervals)
def test_what_a_relay_takes_in_is_a_queue_too_while_the_sender_is_at_it(rate, steps):
    """Little is outstanding where something on the way has room of its own."""
    drain, now, acknowledged, excused = SocketProgress(), 100.0, 0, 0.0
    drain.look(Flow(0, 0, 100), now)
    for step in steps:
        now += step
        acknowledged += int(rate * step)
        excused += drain.look(Flow(acknowledged, 0, 100), now, now - 100.0)
    assert abs(excused - sum(steps)) < 1e-6
    assert drain.look(Flow(acknowledged + 1, 0, 100), now + 1.0, 0.5) == 0.0  # another one


def test_a_large_response_on_its_way_is_a_sign_of_life():
    """What the replica says of itself waits behind it."""
    drain = SocketProgress()
    drain.look(Flow(0, 0, 0), 1.0)
    assert drain.look(Flow(0, 50_000, 0), 1.5) == 0.5
    assert drain.look(Flow(0, 50_100, 0), 2.0) == 0.0


@given(st.lists(st.tuples(st.floats(0.06, 3.0), st.booleans()), max_size=30))
def test_stuck_is_the_time_without_any_acknowledgement(steps):
    """From the look that found bytes outstanding, until one of them is acknowledged."""
    drain, now, acknowledged, since = SocketProgress(), 1.0, 0, 1.0
    drain.look(Flow(0, 0, 10), now)
    for step, moves in steps:
        now += step
        if moves:
            acknowledged += 1
            since = now
        drain.look(Flow(acknowledged, 0, 10), now)
        assert abs(drain.stuck_s(now) - (now - since)) < 1e-6
    drain.look(Flow(acknowledged + 10, 0, 0), now + 1.0)
    assert drain.stuck_s(now + 9.0) == 0.0
