"""Topics: what is kept and in what order it goes, and which of several messages the robot gets."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model.plain import from_plain, to_plain
from fogft.model.topic import Origin, Select, TopicSpec
from fogft.topics.queues import Outbox, Ring, Seen
from fogft.topics.select import QUIET_LIMIT_S, QUIET_S, Selection


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
    assert [ring.put(b"x" * size) for size in (60, 60, 300)] == [0, 1, 1]
    assert [len(m) for _, m in ring.after(ring.begin(), 1 << 20)] == [300]


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
            if seen.is_new(b"robot", one[0]):
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
        if seen.is_new(b"robot", one[0]):
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
    seen.robots = 2
    assert [seen.is_new(b"a", 5), seen.is_new(b"a", 5), seen.is_new(b"a", 4)] == [
        True,
        False,
        False,
    ]
    assert seen.is_new(b"b", 1)


def message(stamp: int, text: bytes = b"") -> bytes:
    return b"\x00\x01\x00\x00" + stamp.to_bytes(8, "little") + text


@given(skew=st.floats(0.0, 0.4), period=st.floats(0.5, 5.0), count=st.integers(3, 20))
def test_of_a_leader_and_its_followers_each_message_is_heard_once(skew, period, count):
    """Replicas that say the same within a part of their period."""
    selection, heard = Selection(Select.LEADER), []
    for number in range(count):
        for replica in (0, 1, 2):
            now = number * period + replica * skew * period / 2
            if selection.passes(replica, message(number), now):
                heard.append(number)
    assert heard == list(range(count))


def test_another_one_leads_when_the_leader_leaves_or_is_silent():
    selection = Selection(Select.LEADER)
    assert selection.passes(0, b"", 0.0)
    assert not selection.passes(1, b"", 0.5)
    selection.left(0)
    assert selection.passes(1, b"", 0.6)
    assert not selection.passes(0, b"", 0.6 + QUIET_LIMIT_S)  # how often 1 speaks is not known
    assert selection.passes(1, b"", 11.0)
    assert selection.passes(1, b"", 11.1)
    assert not selection.passes(0, b"", 11.1 + QUIET_S)
    assert selection.passes(0, b"", 11.1 + QUIET_S + 0.01)


def test_the_first_of_each_stamp_passes_whoever_says_it():
    selection = Selection(Select.STAMP)
    said = [(0, 7), (1, 7), (1, 8), (0, 8), (2, 7), (2, 9)]
    passed = [(r, s) for r, s in said if selection.passes(r, message(s), 0.0)]
    assert passed == [(0, 7), (1, 8), (2, 9)]


def test_without_a_stamp_one_replica_leads():
    selection = Selection(Select.STAMP)
    assert [selection.passes(r, message(0), 0.1) for r in (0, 1, 0)] == [True, False, True]


def test_feedback_has_a_leader_for_each_goal():
    selection = Selection(Select.GOAL)
    one, other = b"\0\1\0\0" + b"a" * 16 + b"x", b"\0\1\0\0" + b"b" * 16 + b"x"
    assert selection.passes(0, one, 0.0)
    assert selection.passes(1, other, 0.0)
    assert not selection.passes(1, one, 0.1)
    assert selection.passes(0, one, 0.2)


@pytest.mark.parametrize("select", Select)
def test_a_configuration_says_all_of_a_topic(select):
    topic = TopicSpec("/a", "p/msg/T", Origin.REPLICAS, select, 3, reliable=False, latched=True)
    assert from_plain(TopicSpec, to_plain(topic)) == topic
    assert to_plain(TopicSpec("/a", "p/msg/T", Origin.ROBOT), omit_defaults=True) == {
        "name": "/a", "type": "p/msg/T", "from": "robot",
    }  # fmt: skip
    with pytest.raises(ValueError, match=r"depth: 0\.5 is not of type `int`"):
        from_plain(TopicSpec, {**to_plain(topic), "depth": 0.5})
