"""What an action's bytes mean, which goals are under way, and whose word about them counts."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model.refusal import Refusal
from fogft.model.spec import Part
from fogft.topics import goals
from fogft.topics.goals import Goals

HEADER = b"\0\1\0\0"


def goal(number: int) -> bytes:
    return bytes([number]) * 16


def request(number: int, size: int = 0) -> bytes:
    return HEADER + goal(number) + bytes(size)


def under_way(*replicas: int) -> Goals:
    """One goal that these were given at 0.0 with 5 s time; the first has taken it, at 1.0."""
    given_to = Goals()
    given_to.made(request(1), b"id", replicas, until=5.0)
    given_to.took(b"id", replicas[0], 1.0, accepts=True)
    given_to.awaited(goal(1))
    return given_to


def test_a_goal_is_known_by_the_id_that_its_client_gave_it():
    request = b"\0\1\0\0" + b"i" * 16 + b"\5\0\0\0"
    assert goals.goal_of(request) == b"i" * 16
    assert goals.goal_of(goals.cancel_request(b"i" * 16)) == b"i" * 16
    assert len(goals.cancel_request(b"i" * 16)) == 4 + 16 + 8


@pytest.mark.parametrize(
    ("part", "response", "success"),
    [
        (Part.GOAL, b"\0\1\0\0\1", True),
        (Part.GOAL, b"\0\1\0\0\0", False),
        (Part.RESULT, b"\0\1\0\0\4", True),
        (Part.RESULT, b"\0\1\0\0\5", False),
        (Part.RESULT, b"\0\1\0\0\0", False),
        (Part.CANCEL, b"\0\1\0\0\0\0\0\0\1\0\0\0", True),
        (Part.CANCEL, b"\0\1\0\0\0\0\0\0\0\0\0\0", False),
        (Part.CANCEL, b"\0\1\0\0\1\0\0\0\1\0\0\0", False),
        (Part.CANCEL, b"", False),
        (Part.CANCEL, b"\0\0\0\0\0\0\0\0\0\0\0\1", True),
        (Part.GOAL, b"", False),
        (Part.RESULT, b"", False),
    ],
)
def test_what_a_success_is(part, response, success):
    assert goals.is_success(part, response) is success
    assert not goals.is_unknown(b"\0\1\0\0\4")
    assert goals.is_unknown(b"\0\1\0\0\0")


@pytest.mark.parametrize(
    ("goal_id", "stamp", "one"),
    [
        (b"i" * 16, bytes(8), True),
        (b"i" * 16, b"\0" * 7 + b"\1", False),  # it, and all before a moment
        (bytes(16), bytes(8), False),  # all
        (bytes(16), b"\1" * 8, False),  # all before a moment
    ],
)
def test_which_cancellations_mean_one_goal(goal_id, stamp, one):
    assert goals.names_one(HEADER + goal_id + stamp) is one
    assert goals.names_one(goals.cancel_request(b"i" * 16))


def test_a_goals_status_is_the_furthest_that_a_replica_gives_it():
    said = {0: {b"a": 6, b"b": 2, b"c": 5}, 1: {b"a": 2, b"b": 4}, 2: {b"c": 6}}
    assert goals.merged(said) == {b"a": 2, b"b": 4, b"c": 5}


def test_of_two_statuses_the_one_counts_that_says_more():
    """Done well before all; then the furthest under way; ends count only where nothing else is."""
    in_order = [0, 6, 5, 1, 2, 3, 4]
    for low, high in pairwise(in_order):
        for said in ({0: {b"g": low}, 1: {b"g": high}}, {0: {b"g": high}, 1: {b"g": low}}):
            assert goals.merged(said) == {b"g": high}
    assert goals.merged({0: {b"g": 77}, 1: {b"g": 6}}) == {b"g": 6}, "no status that ROS knows"
    assert goals.merged({}) == {}


def test_a_goal_is_under_way_from_its_first_acceptance_to_its_end():
    made = Goals()
    made.made(request(1), b"id", (1, 2), until=5.0)
    assert goal(1) not in made
    made.took(b"id", 1, 1.0, accepts=False)
    assert goal(1) not in made
    made.took(b"id", 2, 1.0, accepts=True)
    assert goal(1) in made
    made.ended(goal(1))
    assert goal(1) not in made
    made.took(b"id", 1, 2.0, accepts=True)
    assert goal(1) not in made, "it is over"


def test_only_awaited_goals_are_given_again():
    """One whose client went away would otherwise begin anew on each replica that comes."""
    made = Goals()
    made.made(request(1), b"id", (1,), until=5.0)
    made.awaited(goal(1))  # before anybody took it: nobody can have asked for its result
    made.took(b"id", 1, 1.0, accepts=True)
    assert made.lacking(2, 1.0) == []
    made.awaited(goal(1))
    assert made.lacking(2, 1.0) == [request(1)]
    assert made.lacking(1, 1e9) == []


def test_who_was_given_a_goal_has_time_to_say_so():
    made = under_way(1)
    made.gave(goal(1), b"again", 2, until=7.0)
    assert made.lacking(2, 6.9) == []
    assert made.lacking(2, 7.0) == [request(1)]


@pytest.mark.parametrize("accepts", [True, False])
def test_who_has_answered_is_not_given_it_again_unless_it_may_have_lost_it(accepts):
    for loses in (lambda made: made.left(2), lambda made: made.lost(goal(1), 2)):
        made = under_way(1, 2)
        made.took(b"id", 2, 2.0, accepts=accepts)
        made.failed(b"id", 2, 3.0)  # another of its copies was lost
        assert made.lacking(2, 1e9) == []
        loses(made)
        assert made.lacking(2, 3.0) == [request(1)]


def test_who_did_not_look_at_it_is_given_it_again_in_a_moment():
    made = under_way(1, 2)
    made.failed(b"id", 2, 2.0)
    assert made.lacking(2, 2.0) == []
    assert made.lacking(2, 3.0) == [request(1)]


def test_who_never_looks_at_it_is_left_alone_for_longer_each_time():
    made, now, waits = under_way(1, 2), 2.0, []
    for _ in range(8):
        made.failed(b"id", 2, now)
        wait_s = next(n / 8 for n in range(1000) if made.lacking(2, now + n / 8))
        waits.append(wait_s)
        now += wait_s
        made.gave(goal(1), b"id", 2, until=now + 5.0)
    assert waits == [0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 8.0, 8.0]
    made.left(2)
    made.failed(b"id", 2, now)
    assert made.lacking(2, now + 0.25) == [request(1)], "another one, of which nothing is known"


@pytest.mark.parametrize(
    ("said", "asked_at", "lacked"),
    [
        ([], 9.0, Refusal.NOT_READY),
        ([True], 9.0, None),
        ([True], 2.0, None),
        ([True], 1.0, Refusal.NOT_READY),  # it was asked for the result before it took the goal
        ([False], 1.0, Refusal.FORGOTTEN),
        ([True, False], 9.0, None),  # it has it already: action servers refuse a second one
        ([False, True], 9.0, None),
        ([False, True], 1.0, Refusal.NOT_READY),
    ],
)
def test_what_it_says_of_a_goal_counts_from_when_it_has_answered(said, asked_at, lacked):
    made = under_way(1, 2)
    for accepts in said:
        made.took(b"id", 2, 2.0, accepts=accepts)
    assert made.lacked(goal(1), 2, asked_at) is lacked


def test_nobody_has_said_anything_of_a_goal_that_is_not_known():
    assert Goals().lacked(goal(1), 1, 9.0) is Refusal.NOT_READY
    for step in (Goals().ended, Goals().awaited):
        step(goal(1))
    Goals().lost(goal(1), 1)
    Goals().failed(b"id", 1, 0.0)


def test_what_is_kept_is_bounded_by_number_and_by_bytes(monkeypatch):
    monkeypatch.setattr(goals, "GOALS_KEPT", 3)
    monkeypatch.setattr(goals, "BYTES_KEPT", 1000)
    made = Goals()
    for number in range(5):
        made.made(request(number), bytes([number]), (1,), until=5.0)
        made.took(bytes([number]), 1, 1.0, accepts=True)
    assert [goal(number) in made for number in range(5)] == [False, False, True, True, True]
    made.made(request(9, 2000), b"large", (1,), until=5.0)
    made.took(b"large", 1, 1.0, accepts=True)
    assert [goal(number) in made for number in (2, 3, 4, 9)] == [False, False, False, True]


_STEPS = st.lists(
    st.tuples(
        st.sampled_from(["made", "gave", "took", "refused", "failed", "lost", "left", "ended"]),
        st.integers(1, 3),  # goal
        st.integers(1, 3),  # replica
    )
)


@given(_STEPS)
def test_nothing_is_left_of_goals_that_ended(steps):
    """Whatever happened to them, in whatever order."""
    made, ids = Goals(), 0
    for now, (step, number, replica) in enumerate(steps):
        id = ids.to_bytes(2, "big")
        if step in {"made", "gave"}:
            ids += 1
            id = ids.to_bytes(2, "big")
        {
            "made": lambda n=number, r=replica, i=id: made.made(request(n), i, (r,), until=5.0),
            "gave": lambda n=number, r=replica, i=id: made.gave(goal(n), i, r, until=5.0),
            "took": lambda r=replica, i=id, t=now: made.took(i, r, t, accepts=True),
            "refused": lambda r=replica, i=id, t=now: made.took(i, r, t, accepts=False),
            "failed": lambda r=replica, i=id, t=now: made.failed(i, r, t),
            "lost": lambda n=number, r=replica: made.lost(goal(n), r),
            "left": lambda r=replica: made.left(r),
            "ended": lambda n=number: made.ended(goal(n)),
        }[step]()
        made.awaited(goal(number))
        assert all(request(n) not in made.lacking(replica, 1e9) or goal(n) in made
                   for n in (1, 2, 3))  # fmt: skip
    for number in (1, 2, 3):
        made.ended(goal(number))
    assert len(made.over) <= ids
    assert made.kept == 0
    assert made.lacking(1, 1e9) == []


@given(st.binary(max_size=80))
def test_any_bytes_name_only_whole_goals(response):
    assert all(len(goal) == 16 for goal in goals.cancelled(response))


@pytest.mark.parametrize(("header", "order"), [(b"\0\1\0\0", "little"), (b"\0\0\0\0", "big")])
def test_a_cancellation_names_its_goals_in_either_byte_order(header, order):
    count, stamp = (2).to_bytes(4, order), bytes(8)
    response = header + bytes(4) + count + goal(1) + stamp + goal(2) + stamp
    assert goals.cancelled(response) == [goal(1), goal(2)]
    assert goals.cancelled(response[:-30]) == [goal(1)]


def test_goals_that_nobody_awaits_are_forgotten_first(monkeypatch):
    monkeypatch.setattr(goals, "GOALS_KEPT", 3)
    made = under_way(1)
    for number in range(2, 9):
        made.made(request(number), bytes([number]), (1,), until=5.0)
    assert made.lacking(2, 9.0) == [request(1)]
    assert made.kept == 3
    assert made.took(bytes([8]), 1, 1.0, accepts=True)[0] == goal(8)


def test_who_takes_a_goal_that_was_forgotten_does_not_do_so_in_vain(monkeypatch):
    """Only we have forgotten it: its client has not."""
    monkeypatch.setattr(goals, "GOALS_KEPT", 1)
    made = Goals()
    for number in (1, 2):
        made.made(request(number), bytes([number]), (1,), until=5.0)
    assert made.took(bytes([1]), 1, 1.0, accepts=True)[0] is None
    assert made.took(bytes([2]), 1, 1.0, accepts=True) == (goal(2), False)


def test_a_goal_that_was_made_while_nobody_was_there_is_known():
    made = Goals()
    made.made(request(1), b"id", (), until=5.0)
    made.took(b"id", 1, 1.0, accepts=True)
    made.awaited(goal(1))
    assert made.lacking(2, 1.0) == [request(1)]
    made.left(1)
    assert made.takers(goal(1)) == {1}
    assert made.takers(goal(2)) == frozenset()


def test_what_was_cancelled_is_unwanted_until_it_is_over():
    made = under_way(1)
    assert made.unwanted() == []
    made.cancelled(goal(1))
    assert made.unwanted() == [goal(1)]
    made.ended(goal(1))
    assert made.unwanted() == []


def test_a_goal_that_was_cancelled_is_given_to_nobody_and_nobody_is_expected_to_know_it():
    made = under_way(1, 2)
    made.cancelled(goal(1))
    made.awaited(goal(1))  # its client asks what became of it
    assert made.lacking(3, 9.0) == []
    assert made.lacked(goal(1), 3, 0.0) is None
    assert made.took(b"id", 2, 2.0, accepts=True) == (goal(1), True)
    made.ended(goal(1))
    assert made.took(b"id", 3, 2.0, accepts=True) == (None, True)


def test_who_takes_a_goal_that_is_over_does_so_in_vain():
    made = under_way(1, 2)
    made.ended(goal(1))
    assert made.took(b"id", 2, 2.0, accepts=False)[0] is None
    assert made.took(b"id", 2, 2.0, accepts=True) == (goal(1), True)


def test_of_goals_that_are_over_the_oldest_are_forgotten(monkeypatch):
    monkeypatch.setattr(goals, "GOALS_KEPT", 2)
    made = Goals()
    for number in (1, 2, 3):
        made.made(request(number), bytes([number]), (1,), until=5.0)
        made.ended(goal(number))
    known = [made.took(bytes([number]), 1, 1.0, accepts=True)[0] for number in (1, 2, 3)]
    assert known == [None, goal(2), goal(3)]


def test_as_many_goals_and_bytes_as_may_be_are_kept(monkeypatch):
    monkeypatch.setattr(goals, "GOALS_KEPT", 3)
    monkeypatch.setattr(goals, "BYTES_KEPT", 3 * len(request(0)))
    made = Goals()
    for number in (1, 2, 3):
        made.made(request(number), bytes([number]), (1,), until=5.0)
    assert made.kept == 3
    made.made(request(3), b"again", (2,), until=5.0)
    assert made.kept == 3, "a goal that is made again is no other one"
    made.made(request(4, 1), bytes([4]), (1,), until=5.0)
    assert made.kept == 2


def test_all_goals_are_forgotten_at_once():
    made = under_way(1, 2)
    made.clear()
    assert (made.kept, made.lacking(2, 9.0), made.unwanted()) == (0, [], [])
    assert made.took(b"id", 2, 9.0, accepts=True) == (goal(1), True), "it takes it in vain"
