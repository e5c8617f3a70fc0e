"""What is kept of the last offers is what would be worked out anew."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from fogft.model.replica import Offer, Placement
from fogft.planning.listing import Catalogue, Scale, catalogue

offers = st.lists(
    st.builds(
        Offer,
        st.builds(
            Placement,
            st.sampled_from("ab"),
            st.sampled_from("rs"),
            st.sampled_from("12"),
            st.sampled_from("mn"),
            st.booleans(),
        ),
        st.sampled_from([0.1, 0.2, 0.0, -1.0, math.inf, math.nan]),
        group=st.sampled_from(["", "big"]),
    ),
    max_size=12,
).map(tuple)
questions = st.lists(
    st.tuples(
        st.sampled_from([None, "", "big"]),
        st.sampled_from([None, True, False]),
        st.sampled_from([(), ("a",), ("b/r", "a/s/1")]),
        st.builds(
            Scale,
            st.sampled_from([0.0, 1.0, 2.0]),
            st.sampled_from([{}, {"a/r": 0.01}, {"a/r": 0.2, "b/s": 0.1}]),
        ),
    ),
    min_size=1,
    max_size=6,
)


@given(offers, offers, questions)
def test_what_is_kept_is_what_would_be_worked_out(sold, others, asked):
    """Whatever was asked before, of these or other offers, the answer is a fresh look's."""
    for question in asked:
        for some in (sold, others, sold):
            kept = catalogue(some).listing(*question)
            fresh = Catalogue(some).listing(*question)
            assert [row.offer for row in kept.rows] == [row.offer for row in fresh.rows]
            assert kept.trouble == fresh.trouble


def test_a_list_that_changes_is_looked_at_each_time():
    place = Placement("a", "r", "1", "m")
    sold = [Offer(place, 0.1)]
    assert catalogue(sold).today == {("", place): 0.1}
    sold[0] = Offer(place, 0.2)
    assert catalogue(sold).today == {("", place): 0.2}


@given(offers)
def test_rows_are_the_possible_offers_by_score(sold):
    rows = Catalogue(sold).listing(None, None, (), Scale()).rows
    assert sorted(row.score for row in rows) == [row.score for row in rows]
    assert all(math.isfinite(row.usd_per_hour) and row.usd_per_hour >= 0 for row in rows)
