"""What is not sent because it cannot arrive in time: by numbers, and through a slow relay."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import count

from hypothesis import given
from hypothesis import strategies as st

from fogft.link.compression import Compression
from fogft.link.port import SendOptions
from fogft.link.socket_progress import (
    BULK_BYTES,
    KEPT_S,
    DeadlineFilter,
    Flow,
    SocketProgress,
    Throughput,
)
from fogft.link.zenoh.robot.dialer import ZenohDialer
from fogft.link.zenoh.settings import LinkSettings
from fogft.model.spec import ServiceSpec
from fogft.model.state import StateService, StateSpec
from tests.link.thin_relay import ThinRelay
from tests.link.wire_pool import (
    POOL_UID,
    SERVICE,
    Authority,
    Owner,
    ReplicaProcess,
    keys,
    peer,
    request_id,
    wait_for,
)

rates = st.floats(1e4, 1e7)
LOOK_S = 0.1
LONG_S = 90.0


def queued(carried: Throughput, rate: float, lasts_s: float, now: float) -> float:
    """Look at a queue that moves evenly for so long; return the time after it."""
    for _ in range(round(lasts_s / LOOK_S)):
        now += LOOK_S
        carried.look(round(rate * LOOK_S), LOOK_S, now, queued=True)
    return now


@given(rates, st.floats(2.5, 20.0))
def test_a_link_is_known_after_some_time_under_load_and_not_for_ever(rate, lasts_s):
    carried = Throughput()
    now = queued(carried, rate, lasts_s, 50.0)
    found = carried.bytes_per_s(now)
    assert found is not None
    assert abs(found - rate) <= 0.02 * rate + 10
    assert carried.steady_bytes_per_s == found or lasts_s > KEPT_S
    assert carried.bytes_per_s(now + KEPT_S + 1.0) is None


@given(st.lists(st.tuples(rates, st.booleans()), max_size=60))
def test_a_link_without_a_queue_that_lasts_is_never_known(looks):
    """What is quick leaves no queue, or none for as long as a span."""
    carried, now = Throughput(), 50.0
    for at, (rate, waits) in enumerate(looks):
        now += LOOK_S
        carried.look(int(rate * LOOK_S), LOOK_S, now, queued=waits and at % 4 != 0)
        assert carried.bytes_per_s(now) is None
        assert carried.steady_bytes_per_s is None


@given(rates, st.floats(0.3, 1.0), st.integers(0, 9))
def test_one_pause_makes_no_link_thinner(rate, pause_s, phase):
    """However it falls: a busy peer's second is no sign of what the link carries."""
    carried = Throughput()
    now = queued(carried, rate, 3.0 + phase * LOOK_S, 50.0)
    now = queued(carried, 0.0, pause_s, now)
    now = queued(carried, rate, 0.5, now)
    found = carried.bytes_per_s(now)
    assert found is not None
    assert abs(found - rate) <= 0.02 * rate + 10


def test_what_was_thin_and_is_so_no_more_is_found_out():
    """As after a freeze: what waited leaves at once."""
    carried = Throughput()
    now = queued(carried, 1e5, 2.0, 50.0)
    assert carried.steady_bytes_per_s is not None
    carried.look(100_000, LOOK_S, now + LOOK_S, queued=False)
    assert carried.steady_bytes_per_s is None


@given(rates, st.integers(BULK_BYTES, 10**7), st.booleans())
def test_much_on_its_way_is_no_queue(rate, on_its_way, waits):
    """A long path holds a lot; only where some of it cannot leave the link carries no more."""
    drain, now = SocketProgress(), 50.0
    for look in range(40):
        unsent = on_its_way // 2 if waits else 0
        drain.look(Flow(round(rate * LOOK_S * look), 0, on_its_way, unsent=unsent), now)
        now += LOOK_S
    assert (drain.throughput.bytes_per_s(now) is not None) == waits


@dataclass
class Request:
    size: int
    offered: float
    deadline: float
    service: str = SERVICE


def none_left(now: float, bytes_per_s: float) -> float:
    return 0.0


def carry(
    requests: Iterable[Request], rate: float, *, known: float | None
) -> tuple[list[Request], list[Request]]:
    """Send requests in order over a link; return what arrived in time, and what left for nothing.

    Args:
        requests: By the time at which they are offered.
        rate: What the link carries, in bytes a second.
        known: What is known of that.
    """
    judge = DeadlineFilter({SERVICE}, lambda now: known, none_left, lambda service: None)
    waiting: deque[Request] = deque()
    good: list[Request] = []
    wasted: list[Request] = []
    free_at = 0.0

    def drain(until: float) -> None:
        nonlocal free_at
        while waiting and free_at <= until:
            request = waiting.popleft()
            left_s = request.deadline - free_at
            if left_s <= 0 or not judge.may_arrive(request, left_s, free_at):
                continue
            free_at += request.size / rate
            (good if free_at <= request.deadline + 1e-9 else wasted).append(request)

    for request in requests:
        now = request.offered
        drain(now)
        free_at = max(free_at, now) if not waiting else free_at
        if judge.may_arrive(request, request.deadline - now, now, lambda service: tuple(waiting)):
            waiting.append(request)
            drain(now)
    drain(float("inf"))
    return good, wasted


scenes = st.lists(
    st.tuples(st.floats(0.0, 3.0), st.integers(1, 10**6), st.floats(0.05, 20.0)), max_size=40
)


def requests_of(scene: list[tuple[float, int, float]]) -> list[Request]:
    now, made = 1.0, []
    for gap_s, size, lasts_s in scene:
        now += gap_s
        made.append(Request(size, now, now + lasts_s))
    return made


@given(scenes, rates)
def test_nothing_leaves_in_vain_over_a_link_that_is_known(scene, rate):
    """Whatever is sent arrives before its deadline."""
    _, wasted = carry(requests_of(scene), rate, known=rate)
    assert wasted == []


@given(scenes, rates, st.floats(1.0, 10.0))
def test_nobody_is_turned_away_over_a_link_that_is_not_full(scene, rate, spare):
    """Each request arrives that comes to an idle link with time enough, and with some to spare."""
    idle, before_s = [], 0.0
    for gap_s, size, _ in scene:
        idle.append((gap_s + before_s + 1e-3, size, spare * size / rate + 1e-3))
        before_s = size / rate
    good, wasted = carry(requests_of(idle), rate, known=rate)
    assert (len(good), wasted) == (len(scene), [])


def test_a_thin_link_that_is_asked_for_more_than_it_carries_answers_what_it_can():
    """300 kB each second over 1 Mbit/s, six seconds each: none of the later ones came before."""
    asked = [Request(300_000, float(at), at + 6.0) for at in range(1, 301)]
    rate = 125_000.0
    good, wasted = carry(asked, rate, known=None)
    assert len(good) <= 5
    assert len(wasted) > 100
    good, wasted = carry(asked, rate, known=rate)
    assert len(good) >= 0.95 * 300 * rate / 300_000
    assert wasted == []


@given(st.integers(1, 10**6), st.one_of(st.none(), st.floats(0.01, 1.0)))
def test_what_shrinks_is_judged_by_what_is_left_of_it(size, ratio):
    """And where that is not known yet, it is let through."""
    packs = Compression()
    packs.ratio = ratio
    judge = DeadlineFilter({SERVICE}, lambda now: 1000.0, none_left, lambda service: packs)
    needs_s = 0.0 if ratio is None else size * ratio / 1000.0
    assert judge.may_arrive(Request(size, 0.0, 0.0), needs_s + 1e-6, 0.0)
    if needs_s > 1e-6:
        assert not judge.may_arrive(Request(size, 0.0, 0.0), needs_s - 1e-6, 0.0)


def test_what_is_wanted_whenever_it_comes_is_sent():
    """The orders of a stateful service, and topics: their time only says when to send again."""
    state = StateSpec(StateService("/get", "t/srv/G", "f"), StateService("/set", "t/srv/P", "f"))
    services = [ServiceSpec("/plain", "t/srv/T"), ServiceSpec("/kept", "t/srv/T", state=state)]
    judge = DeadlineFilter(
        SendOptions.of(services).timed, lambda now: 1000.0, none_left, lambda service: None
    )
    assert not judge.may_arrive(Request(5000, 0.0, 1.0, "/plain"), 1.0, 0.0)
    assert judge.may_arrive(Request(5000, 0.0, 1.0, "/kept"), 1.0, 0.0)
    assert judge.may_arrive(Request(5000, 0.0, 1.0, "topic /map"), 1.0, 0.0)


@given(rates, st.integers(0, 10**7), st.integers(1, 10**6), st.floats(0.0, 5.0))
def test_what_is_still_under_way_leaves_first(rate, outstanding, size, age_s):
    """As much of it as has not left since it was looked at."""
    drain = SocketProgress()
    drain.look(Flow(0, 0, outstanding), 50.0)
    judge = DeadlineFilter({SERVICE}, lambda now: rate, drain.left_bytes, lambda service: None)
    needs_s = max(0.0, outstanding / rate - age_s) + size / rate
    assert judge.may_arrive(Request(size, 0.0, 0.0), needs_s * 1.001 + 1e-6, 50.0 + age_s)
    assert not judge.may_arrive(Request(size, 0.0, 0.0), needs_s * 0.999 - 1e-6, 50.0 + age_s)


def test_a_request_that_cannot_arrive_is_declined_while_the_link_is_busy(
    start_replica: Callable[..., ReplicaProcess], authority: Authority, owner: Owner
) -> None:
    """Through a relay of 2 Mbit/s; what has time enough is taken, and answered."""
    relay = ThinRelay(start_replica(reply_bytes=16).endpoint, 250_000)
    dialer = ZenohDialer(
        authority.robot(), robot="robot", pool_uid=POOL_UID, suspect_after_s=LONG_S,
        settings=LinkSettings(stall_after_s=LONG_S),
    )  # fmt: skip
    dialer.adopt(SendOptions(plain=frozenset({SERVICE}), timed=frozenset({SERVICE})))
    payload = os.urandom(500_000)
    numbers = count(100)

    def declined() -> bool:
        number = request_id(next(numbers))
        taken = link.offer(SERVICE, number, payload, 0.3)
        link.forget(number)
        return not taken

    try:
        link = dialer.dial(peer(relay.endpoint), keys(0), owner)
        wait_for(lambda: link.usable, LONG_S)
        for number in range(10):  # twenty seconds of it
            assert link.offer(SERVICE, request_id(number), payload, LONG_S)
        wait_for(declined, LONG_S)
        assert link.usable
        relay.bytes_per_s = float("inf")
        assert link.offer(SERVICE, request_id(50), b"small, and in no hurry", LONG_S)
        wait_for(lambda: all(owner.of(n) for n in (*range(10), 50)), LONG_S)
        assert {owner.of(n)[0].refusal for n in (*range(10), 50)} == {None}
    finally:
        dialer.close()
        relay.close()
