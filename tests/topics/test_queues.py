"""Topics' queues: what is kept, and in what order it goes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.topics.queues import Judgement, Outbox, Ring, Seen

TWO_STARTS = ((b"a", 5), (b"a", 5), (b"a", 4), (b"b", 1))


def is_new(seen: Seen, number: int, robot: str = "robot") -> bool:
    return seen.judge(robot, b"start", number) is Judgement.NEW


@given(
    depth=st.integers(1, 8), latched=st.booleans(),
    steps=st.lists(st.one_of(st.just("put"), st.just("pull")), max_size=60),
)  # fmt: skip
def test_who_pulls_often_enough_hears_all_in_order_and_nothing_twice(depth, latched, steps):
    """And who does not loses the oldest only. What was kept before counts where it is latched."""
    ring = Ring(depth, latched=latched)
    for number in range(3):
        ring.put(b"%d" % number)
    has, heard = ring.begin(), []
    unheard = 0
    for step in steps:
        if step == "put":
            ring.put(b"%d" % ring.last)
            unheard += 1
            continue
        got = ring.after(has, 1 << 20)
        heard += [int(message) for _, message in got]
        has = got[-1][0] if got else has
        unheard = 0
    assert heard == sorted(set(heard))
    if not latched:
        assert all(number >= 3 for number in heard)
    elif "pull" in steps and "put" not in steps:
        assert heard == list(range(max(0, 3 - depth), 3))
    if unheard <= depth and steps and steps[-1] == "pull":
        assert not heard or heard[-1] == ring.last - 1


def test_a_batch_has_at_least_one_message_and_then_at_most_so_many_bytes():
    ring = Ring(10, latched=False)
    for size in (50, 10, 10, 100):
        ring.put(b"x" * size)
    assert [len(m) for _, m in ring.after(0, 20)] == [50]
    assert [len(m) for _, m in ring.after(1, 20)] == [10, 10]


def test_what_is_kept_is_bounded_in_bytes_but_the_newest_stays():
    ring = Ring(10, latched=True)
    ring.kept_bytes = 100
    for size in (60, 60, 300):
        ring.put(b"x" * size)
        assert [len(m) for _, m in ring.after(ring.begin(), 1 << 20)] == [size]


@given(
    depth=st.integers(1, 6), window=st.integers(1, 4),
    steps=st.lists(st.sampled_from(["put", "send", "confirm", "break", "lose"]), max_size=80),
)  # fmt: skip
def test_a_replica_gets_each_message_once_and_in_order(depth, window, steps):
    """Whatever is lost and sent again; only the oldest of too many that wait are left out."""
    outbox, seen = Outbox(depth), Seen()
    outbox.window = window
    under_way: list[int] = []
    got: list[int] = []
    put = gone = 0
    for step in steps:
        if step == "put":
            put += 1
            gone += outbox.put(put, b"%d" % put)
        elif step == "send" and (one := outbox.next()) is not None:
            under_way.append(one[0])
            if is_new(seen, one[0]):
                got.append(one[0])
            assert len(under_way) <= window
        elif step == "confirm" and under_way:
            outbox.confirmed(under_way.pop(0))
        elif step == "lose" and under_way:
            outbox.returned([under_way.pop(0)])
        elif step == "break":
            for number in under_way:  # one by one, as it is told
                outbox.returned([number])
            under_way = []
    assert got == sorted(set(got))
    outbox.returned(under_way)
    while (one := outbox.next()) is not None:
        if is_new(seen, one[0]):
            got.append(one[0])
        outbox.confirmed(one[0])
    assert got == sorted(set(got))
    assert len(got) == put - gone or gone


def test_what_waits_for_a_replica_is_bounded_in_bytes_but_the_newest_stays():
    outbox = Outbox(10)
    outbox.kept_bytes = 100
    assert [outbox.put(n, b"x" * size) for n, size in enumerate((60, 60, 300), 1)] == [0, 1, 1]
    assert outbox.next()[0] == 3


def test_a_robot_that_starts_anew_is_another_publisher():
    seen = Seen()
    judged = [seen.judge("r", session, number) for session, number in TWO_STARTS]
    assert judged == [Judgement.NEW, Judgement.KNOWN, Judgement.LATE, Judgement.NEW]
    assert seen.judge("r", b"a", 1 << 62) is Judgement.NEW


@pytest.mark.parametrize("latched", [False, True])
def test_where_a_new_robot_begins(latched):
    """Before all that is kept, where it is latched; else after it."""
    ring = Ring(2, latched=latched)
    assert ring.begin() == 0
    for expected in ((0, 1), (0, 2), (1, 3)):
        ring.put(b"x")
        assert ring.begin() == expected[not latched]


def test_a_batch_is_as_large_as_its_limit_and_no_larger():
    ring = Ring(10, latched=False)
    for size in (10, 10, 1):
        ring.put(b"x" * size)
    assert [number for number, _ in ring.after(0, 20)] == [1, 2]
    assert [number for number, _ in ring.after(0, 19)] == [1]
    assert [number for number, _ in ring.after(1, 20)] == [2, 3]
    assert ring.after(3, 20) == []


@given(st.lists(st.integers(0, 60), max_size=40), st.integers(1, 5))
def test_what_is_kept_is_the_newest_that_has_room(sizes, depth):
    """By number and by bytes."""
    ring = Ring(depth, latched=True)
    ring.kept_bytes = 100
    for size in sizes:
        ring.put(b"x" * size)
    kept = [(number, len(message)) for number, message in ring.after(0, 1 << 20)]
    gone = len(sizes) - len(kept)
    assert kept == list(enumerate(sizes, 1))[gone:]
    assert len(kept) <= depth
    assert sum(size for _, size in kept) <= 100
    fitting = sizes[-len(kept) - 1 :]
    assert not gone or len(fitting) > depth or sum(fitting) > 100, "nothing is dropped in vain"


def test_as_much_as_may_wait_waits_and_no_more():
    outbox = Outbox(2)
    outbox.kept_bytes = 100
    assert [outbox.put(number, b"x" * 50) for number in (1, 2, 3)] == [0, 0, 1]
    assert len(outbox) == 2
    assert outbox.put(4, b"x" * 51) == 2, "with what there is it would be too much"
    assert outbox.put(5, b"x" * 49) == 0
    assert (outbox.next(), outbox.next()) == ((4, b"x" * 51), (5, b"x" * 49))
    assert (outbox.waiting, len(outbox)) == (False, 2)


def test_no_more_than_a_window_is_under_way_and_what_was_lost_goes_before_what_is_later():
    outbox = Outbox(10)
    outbox.window = 2
    for number in (1, 2, 3, 4):
        outbox.put(number, b"")
    assert [one and one[0] for one in (outbox.next(), outbox.next(), outbox.next())] == [1, 2, None]
    outbox.returned([1])
    assert outbox.next() is None, "2 may be lost as well, or have overtaken 1"
    outbox.confirmed(2)
    outbox.confirmed(99)
    assert [one[0] for one in (outbox.next(), outbox.next())] == [1, 3]
    outbox.confirmed(1)
    assert outbox.next()[0] == 4


def test_many_small_messages_are_on_their_way_to_a_replica_that_is_far_away():
    """Else 200 a second would not fit into a round trip of 300 ms."""
    outbox = Outbox(100)
    for number in range(1, 101):
        outbox.put(number, b"small" if number < 90 else bytes(8000))
    for sent in (range(1, 65), range(65, 90), range(90, 101)):
        assert [number for number, _ in iter(outbox.next, None)] == [*sent]
        for number in sent:
            outbox.confirmed(number)


def test_an_earlier_one_that_is_under_way_holds_nothing_up():
    outbox = Outbox(10)
    for number in (1, 2, 3):
        outbox.put(number, b"")
    outbox.next()
    outbox.next()
    outbox.returned([2, 7])
    assert outbox.next()[0] == 2
    assert outbox.next()[0] == 3


def test_the_robots_that_spoke_last_are_remembered():
    """One that is forgotten may begin anew: that is better than to remember all for ever."""
    seen = Seen()
    seen.robots, seen.starts = 2, 2
    for robot, number in (("a", 9), ("b", 9), ("a", 10), ("c", 9)):
        assert is_new(seen, number, robot)
    assert not is_new(seen, 10, "a")
    assert not is_new(seen, 9, "c")
    assert is_new(seen, 9, "b"), "it was silent for longest"
    for start in (b"1", b"2", b"3"):
        assert seen.judge("b", start, 1) is Judgement.NEW
    assert not is_new(seen, 9, "c"), "who starts often puts out only itself"
