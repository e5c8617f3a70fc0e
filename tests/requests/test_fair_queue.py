"""Who is next at a replica: by deadline within a robot, in fair shares between robots."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fogft.requests.fair_queue import FairQueue


def filled(*entries: tuple[str, float]) -> FairQueue[str]:
    """Return a queue of ``(robot, deadline)``; an item is its place, such as ``a1``."""
    queue: FairQueue[str] = FairQueue()
    for n, (robot, deadline) in enumerate(entries):
        queue.put(bytes([n]), robot, deadline, f"{robot}{n}")
    return queue


def drained(queue: FairQueue[str]) -> list[str]:
    return list(iter(queue.take, None))


def test_one_robot_is_served_by_deadline():
    assert drained(filled(("a", 3.0), ("a", 1.0), ("a", 2.0))) == ["a1", "a2", "a0"]


def test_a_chatty_robot_takes_turns_with_a_quiet_one():
    queue = filled(*[("chatty", 1.0)] * 6, ("quiet", 9.0), ("quiet", 9.0))
    served = drained(queue)
    assert served.index("quiet6") <= 1
    assert served.index("quiet7") <= 3


def test_turns_cannot_be_saved_up():
    """A robot that was silent for long gets its share from now on, not what it left."""
    queue = filled(*[("a", 1.0)] * 10)
    for _ in range(8):
        queue.take()
    for n in range(6):
        queue.put(b"b%d" % n, "b", 1.0, f"b{n}")
    assert drained(queue)[:4] in (["a8", "b0", "a9", "b1"], ["b0", "a8", "b1", "a9"])


def test_what_came_to_nothing_costs_no_turn():
    """What is too late when it comes up is not served: its robot still is next."""
    queue = filled(*[("a", 1.0)] * 6, *[("b", 1.0)] * 3)
    for _ in range(3):
        assert queue.take() in ("a0", "a1", "a2")
        queue.not_served("a")
    assert drained(queue)[:4] in (["a3", "b6", "a4", "b7"], ["b6", "a3", "b7", "a4"])


def test_when_full_the_robot_with_most_gives_way():
    queue = filled(("chatty", 1.0), ("chatty", 7.0), ("chatty", 5.0))
    assert queue.evict("quiet", 9.0) == "chatty1"
    assert queue.size() == 2


def test_when_full_an_urgent_request_displaces_a_later_one_of_its_own_robot():
    queue = filled(("a", 1.0), ("a", 7.0))
    assert queue.evict("a", 3.0) == "a1"
    assert queue.evict("a", 9.0) is None


def test_equal_shares_displace_nobody():
    assert filled(("a", 1.0), ("a", 1.0), ("b", 1.0)).evict("b", 0.5) is None


robots = st.sampled_from("abc")
operations = st.lists(
    st.one_of(
        st.tuples(st.just("put"), robots, st.floats(0, 10)),
        st.tuples(st.just("take"), robots, st.just(0.0)),
        st.tuples(st.just("remove"), robots, st.floats(0, 1)),
        st.tuples(st.just("evict"), robots, st.floats(0, 10)),
    ),
    max_size=120,
)


@given(operations)
def test_each_comes_out_once_and_nobody_starves(operations):
    """What is put in comes out once; with n robots waiting each is served every n-th time;
    of two of one robot the earlier deadline goes first."""
    queue: FairQueue[int] = FairQueue()
    waiting: dict[int, tuple[str, float]] = {}
    since: dict[str, int] = {}
    for n, (operation, robot, value) in enumerate(operations):
        if operation == "put":
            queue.put(n.to_bytes(2, "big"), robot, value, n)
            waiting[n] = (robot, value)
            since.setdefault(robot, 0)
        elif operation == "take":
            taken = queue.take()
            if taken is None:
                assert not waiting
                continue
            who, deadline = waiting.pop(taken)
            assert all(deadline <= d for other, d in waiting.values() if other == who)
            for other in since:
                since[other] += 1
            since[who] = 0
        elif operation == "remove" and waiting:
            chosen = sorted(waiting)[int(value * (len(waiting) - 1))]
            assert queue.remove(chosen.to_bytes(2, "big")) == chosen
            del waiting[chosen]
        elif operation == "evict":
            gone = queue.evict(robot, value)
            if gone is not None:
                del waiting[gone]
        present = {who for who, _ in waiting.values()}
        since = {who: count for who, count in since.items() if who in present}
        assert all(count <= 3 for count in since.values())
        assert queue.size() == len(waiting)
    assert queue.ahead("a", 5.0) <= len(waiting)


@given(st.lists(st.tuples(robots, st.floats(0, 100)), min_size=1, max_size=20))
def test_where_the_latest_is_wanted_the_newest_of_each_robot_goes_first(entries):
    """Everybody still gets a turn; what gives way when there is no room is the stalest."""
    queue: FairQueue[tuple[str, float]] = FairQueue(latest=True)
    for n, entry in enumerate(entries):
        queue.put(bytes([n]), *entry, entry)
    served = list(iter(queue.take, None))
    assert sorted(served) == sorted(entries)
    for robot in "abc":
        deadlines = [deadline for name, deadline in served if name == robot]
        assert deadlines == sorted(deadlines, reverse=True)


def test_the_stalest_gives_way_to_a_newer_one_of_its_own_robot():
    queue: FairQueue[str] = FairQueue(latest=True)
    queue.put(b"old", "a", 1.0, "old")
    queue.put(b"new", "a", 7.0, "new")
    assert queue.evict("a", 0.5) is None
    assert queue.evict("a", 9.0) == "old"
    assert queue.ahead("a", 8.0) == 0
    assert queue.ahead("a", 5.0) == 1


def test_an_empty_queue_gives_nothing_and_nothing_has_to_give_way():
    queue = filled()
    assert (queue.take(), queue.remove(b"x"), queue.evict("a", 1.0)) == (None, None, None)
    assert (queue.size(), queue.ahead("a", 1.0)) == (0, 0)


def test_who_was_given_least_is_next_and_among_equals_the_earliest_deadline():
    assert drained(filled(("a", 5.0), ("b", 3.0), ("b", 9.0), ("a", 7.0))) == [
        "b1",
        "a0",
        "a3",
        "b2",
    ]
    assert drained(filled(("a", 1.0), ("a", 1.0))) == ["a0", "a1"], "of equals the first"


def test_what_is_ahead_is_ones_own_and_as_much_of_each_other():
    queue = filled(("a", 1.0), ("a", 5.0), ("b", 9.0), ("c", 9.0), ("c", 9.0), ("c", 9.0))
    assert queue.ahead("a", 0.5) == 0 + 1 + 1
    assert queue.ahead("a", 1.0) == 1 + 1 + 2
    assert queue.ahead("a", 9.0) == 2 + 1 + 3
    assert queue.ahead("d", 9.0) == 0 + 1 + 1 + 1
    queue.remove(bytes([1]))
    assert queue.ahead("a", 9.0) == 1 + 1 + 2


def test_what_was_removed_never_comes_out_however_much_it_is():
    queue = filled(*[("a", float(n)) for n in range(60)])
    for n in range(57):
        assert queue.remove(bytes([n])) == f"a{n}"
    assert queue.remove(bytes([0])) is None
    assert queue.evict("b", 0.0) == "a59"
    assert drained(queue) == ["a57", "a58"]


def test_a_robot_with_one_more_than_another_keeps_it():
    """Else two robots would take each other's places in turns."""
    queue = filled(("a", 1.0), ("a", 1.0), ("b", 1.0))
    assert queue.evict("b", 9.0) is None
    queue.put(b"x", "a", 2.0, "x")
    assert queue.evict("b", 9.0) == "x"
