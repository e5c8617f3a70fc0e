"""Laws of voting: who is believed, who is flagged."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fogft.requests.decide import Means, Pending
from fogft.requests.votes import LIMIT, Quorum

PENDING = Pending(0.0, b"", None, 0.0)


def of(quorum: int, tolerance: float = 0.0) -> Quorum:
    """Votes on numbers that agree where they are no further apart."""
    return Quorum(quorum, float, lambda one, other: abs(one - other) <= tolerance)


def vote(votes: Quorum, request: bytes, replica: int, answer: float) -> bool:
    """Whether an answer decides."""
    return votes.judge(request, replica, b"", answer, PENDING) is Means.SUCCESS


@given(
    st.integers(1, 4),
    st.lists(st.tuples(st.integers(0, 5), st.integers(0, 3)), max_size=12),
    st.sampled_from([0, 1]),
)
def test_an_answer_has_a_quorum_behind_it_and_there_is_one_at_most(quorum, cast, tolerance):
    votes = of(quorum, tolerance)
    first: dict[int, int] = {}
    answers = []
    for replica, value in cast:
        first.setdefault(replica, value)
        if vote(votes, b"r", replica, value):
            answers.append(value)
            assert sum(abs(v - value) <= tolerance for v in first.values()) >= quorum
    assert len(answers) <= 1
    assert votes.hears_out(b"r") == bool(answers)
    if not answers:
        values = list(first.values())
        assert all(
            sum(abs(v - values[j]) <= tolerance for v in values[: j + 1]) < quorum
            for j in range(len(values))
        )


@given(st.lists(st.permutations(range(5)), min_size=1, max_size=30), st.data())
def test_the_honest_win_and_are_never_flagged_while_fewer_than_k_lie(orders, data):
    """Five replicas, a quorum of three, two liars, any order of arrival, any lies."""
    votes = of(3)
    for number, order in enumerate(orders):
        request = number.to_bytes(2, "big")
        for replica in order:
            value = 7.0 if replica < 3 else data.draw(st.sampled_from([7.0, 8.0, 9.0]))
            if vote(votes, request, replica, value):
                assert value == 7.0
        assert votes.hears_out(request)
    assert votes.flagged <= {3, 4}


@given(st.permutations([0, 1, 2]))
def test_a_liar_is_flagged_after_a_few_requests_however_slow_it_is(order):
    votes = of(2)
    for number in range(LIMIT):
        assert 2 not in votes.flagged
        for replica in order:
            vote(votes, bytes([number]), replica, 9.0 if replica == 2 else 7.0)
    assert votes.flagged == {2}
    assert votes.disagreed == {2: LIMIT}


def test_a_flagged_ballot_does_not_count():
    """One that is flagged cannot give a wrong answer its majority."""
    votes = of(2)
    votes.flagged.add(2)
    assert vote(votes, b"r", 2, 9.0) is False
    assert vote(votes, b"r", 1, 9.0) is False
    assert vote(votes, b"r", 0, 9.0) is True


def test_without_agreement_nobody_is_blamed():
    votes = of(2)
    for number in range(50):
        vote(votes, bytes([number]), 0, 1.0)
        vote(votes, bytes([number]), 1, 2.0)
        votes.closed(bytes([number]), PENDING)
    assert not votes.flagged
    assert not votes.disagreed
    assert not vote(votes, bytes([0]), 2, 1.0)  # no ballot of it is kept


def test_a_copy_is_no_second_vote():
    votes = of(2)
    assert vote(votes, b"r", 0, 1.0) is False
    assert vote(votes, b"r", 0, 1.0) is False


def test_a_seldom_error_flags_nobody():
    """Two of twenty are forgiven: cosmic rays are no reason to replace a machine."""
    votes = of(2)
    for number in range(200):
        request = number.to_bytes(2, "big")
        for replica in (0, 1, 2):
            wrong = replica == 2 and number % 10 == 0
            vote(votes, request, replica, 9.0 if wrong else 7.0)
    assert not votes.flagged
    assert votes.disagreed == {2: 20}


def test_final_answers_are_kept_for_a_while_only():
    votes = of(1)
    votes.kept = 10
    for number in range(100):
        vote(votes, bytes([number]), 0, 1.0)
    assert sum(votes.hears_out(bytes([n])) for n in range(100)) == 10


def test_of_large_answers_few_are_kept():
    votes = of(1)
    votes.kept_bytes = 1000
    for number in range(100):
        votes.judge(bytes([number]), 0, bytes(300), 1.0, PENDING)
    assert sum(votes.hears_out(bytes([n])) for n in range(100)) == 3
    votes.judge(b"x", 0, bytes(5000), 1.0, PENDING)
    assert votes.hears_out(b"x")
