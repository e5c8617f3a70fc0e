"""Timers: few pending while many queries come, none cut short while few do."""

from __future__ import annotations

import heapq

from hypothesis import given
from hypothesis import strategies as st

from fogft.wire.timer_budget import SHORTEST_S, TimerBudget

LIMIT = 100


@given(
    rates=st.lists(st.integers(0, 300), min_size=1, max_size=10),
    wanted_s=st.floats(0.1, 1000),
)
def test_pending_timers_are_bounded(rates: list[int], wanted_s: float) -> None:
    """Whatever the rates of successive seconds, the pending timers stay near the limit.

    Above it may be: what one second brings at the shortest time-out, and what came before
    the rate was known.
    """
    budget = TimerBudget(LIMIT)
    pending: list[float] = []
    worst = 0
    for second, rate in enumerate(rates):
        for n in range(rate):
            now = second + n / rate
            while pending and pending[0] <= now:
                heapq.heappop(pending)
            heapq.heappush(pending, now + budget.timeout_s(wanted_s, now))
            worst = max(worst, len(pending))
    assert worst <= 10 * LIMIT + 2 * SHORTEST_S * max(rates)


@given(rate=st.integers(1, 5000), seconds=st.integers(3, 8))
def test_a_steady_stream_keeps_to_the_limit(rate: int, seconds: int) -> None:
    """From the second second on, no more timers are added than the limit allows."""
    budget = TimerBudget(LIMIT)
    ends = []
    for n in range(rate * seconds):
        now = n / rate
        ends.append((now, now + budget.timeout_s(1e6, now)))
    last = ends[-1][0]
    recent = [(began, end) for began, end in ends if began >= 1.0 and end > last]
    assert len(recent) <= max(LIMIT, SHORTEST_S * rate) * 1.1 + 2


@given(wanted_s=st.floats(0.1, 60), gap_s=st.floats(1.1, 5))
def test_a_quiet_service_has_all_its_time(wanted_s: float, gap_s: float) -> None:
    """Requests that come one by one are never cut short."""
    budget = TimerBudget(LIMIT)
    assert all(budget.timeout_s(wanted_s, n * gap_s) == wanted_s for n in range(20))


@given(wanted_s=st.floats(0.001, 1e6), times=st.lists(st.floats(0, 100), max_size=200))
def test_it_never_gives_more_than_was_wanted_nor_too_little(
    wanted_s: float, times: list[float]
) -> None:
    """A short deadline stays short; a long one keeps at least the shortest time-out."""
    budget = TimerBudget(LIMIT)
    for now in sorted(times):
        given_s = budget.timeout_s(wanted_s, now)
        assert min(wanted_s, SHORTEST_S) <= given_s <= wanted_s
