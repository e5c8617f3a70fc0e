"""Which of several replicas' messages the robot gets."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model.topic import Select
from fogft.topics.select import QUIET_LIMIT_S, QUIET_S, Leader, Selection


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


def test_a_stamp_that_a_replica_repeats_is_a_new_one():
    """A simulation's clock jumps back to 7, then stands still at 8; another one comes later."""
    selection = Selection(Select.STAMP)
    said = [(0, 7), (1, 7), (0, 8), (1, 8), (1, 7), (0, 7), (1, 8), (0, 8), (1, 8), (0, 8)]
    passed = [(r, s) for r, s in said if selection.passes(r, message(s), 0.0)]
    assert passed == [(0, 7), (0, 8), (1, 7), (1, 8), (1, 8)]
    assert [selection.passes(2, message(8), 1.1) for _ in range(3)] == [False, True, True]


def test_of_several_messages_with_one_stamp_each_passes_once():
    """As of several cameras, whose detections a replica publishes together."""
    selection = Selection(Select.STAMP)
    said = [0, 0, 0, 1, 1, 2, 1, 2, 2]
    assert [r for r in said if selection.passes(r, message(7), 0.0)] == [0, 0, 0]


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


@pytest.mark.parametrize(
    ("gap_s", "silence_s"),
    [(0.01, QUIET_S), (QUIET_S / 2, QUIET_S), (3.0, 6.0), (QUIET_LIMIT_S, QUIET_LIMIT_S)],
)
def test_a_leader_may_be_silent_for_twice_its_last_gap_within_bounds(gap_s, silence_s):
    leader = Leader()
    assert leader.passes(0, 0.0)
    assert leader.passes(0, gap_s)
    assert not leader.would_pass(1, gap_s + silence_s)
    assert leader.would_pass(1, gap_s + silence_s + 0.01)
    assert leader.would_pass(0, gap_s + silence_s)


def test_who_does_not_lead_changes_nothing_by_leaving_or_speaking():
    leader = Leader()
    leader.passes(0, 0.0)
    assert not leader.passes(1, 9.9)
    leader.left(1)
    assert not leader.would_pass(1, QUIET_LIMIT_S)
    assert leader.would_pass(1, QUIET_LIMIT_S + 0.1)


@given(st.lists(st.tuples(st.integers(0, 2), st.floats(0, 20)), max_size=40))
def test_two_lead_in_turn_only_where_the_first_was_silent_for_a_second(said):
    """However they speak: and a message is dropped only while another one leads."""
    leader, now, last, heard_at = Leader(), 0.0, None, 0.0
    for replica, pause_s in said:
        now += pause_s
        passes = leader.passes(replica, now)
        if passes and last not in (None, replica):
            assert now - heard_at > QUIET_S
        if not passes:
            assert last not in (None, replica)
            assert now - heard_at <= QUIET_LIMIT_S
        else:
            last, heard_at = replica, now


@pytest.mark.parametrize("select", Select)
def test_messages_are_asked_of_all_unless_only_a_leader_counts(select):
    selection = Selection(select)
    selection.passes(0, message(7), 0.0)
    assert selection.wants(0, 0.1)
    assert selection.wants(1, 0.1) is (select is not Select.LEADER)
    selection.left(0)
    assert selection.wants(1, 0.1)


def test_where_nothing_is_selected_all_pass():
    selection = Selection(Select.ALL)
    assert all(selection.passes(replica, message(7), 0.0) for replica in (0, 1, 0, 1))


def test_a_stamp_is_not_the_same_in_another_byte_order_nor_with_other_seconds():
    selection = Selection(Select.STAMP)
    big = b"\0\0" + message(7)[2:]
    assert [selection.passes(0, one, 0.0) for one in (message(7), big, message(7 << 32))] == [
        True,
        True,
        True,
    ]
    assert not selection.passes(1, message(7, b"another text"), 0.0)
    assert not selection.passes(1, message(7 << 32), 0.0)


def test_the_oldest_stamp_and_goal_are_forgotten_in_the_end():
    """Replicas that are that far behind are none that anybody waits for."""
    stamps, goals = Selection(Select.STAMP), Selection(Select.GOAL)
    for number in range(1, 1026):
        assert stamps.passes(0, message(number), 0.0)
        goals.passes(0, feedback(number), 0.0)
    assert not stamps.passes(1, message(2), 0.0)
    assert stamps.passes(1, message(1), 0.0)
    assert not goals.passes(1, feedback(2), 0.1)
    assert goals.passes(1, feedback(1), 0.1)


def feedback(goal: int) -> bytes:
    return b"\0\1\0\0" + goal.to_bytes(16, "little") + b"x"


def test_who_leaves_leads_no_goal_any_more():
    selection = Selection(Select.GOAL)
    for goal in (1, 2):
        selection.passes(0, feedback(goal), 0.0)
    selection.left(0)
    assert all(selection.passes(1, feedback(goal), 0.1) for goal in (1, 2))
    assert not selection.passes(0, feedback(1), 0.2)
