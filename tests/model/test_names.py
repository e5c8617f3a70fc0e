"""Identifiers of connections: the same at both ends for ever, and no two alike."""

from __future__ import annotations

import inspect

from hypothesis import given
from hypothesis import strategies as st

from fogft.model import names

UID = st.text("0123456789abcdef", min_size=16, max_size=16)
PARTS = st.tuples(UID, st.integers(0, 2**33), st.text(max_size=12), st.text(max_size=12))


@given(PARTS, PARTS)
def test_pool_slot_service_and_type_make_the_identifier_and_nothing_else_does(one, other):
    """No address, port or launch goes in: who is launched again elsewhere has the same."""
    assert (names.connection_id(*one) == names.connection_id(*other)) == (one == other)
    assert list(inspect.signature(names.connection_id).parameters) == [
        "pool_uid", "slot", "service", "type_name",
    ]  # fmt: skip


@given(UID, st.integers(0, 2**33), st.text(max_size=6), st.text(max_size=6), st.text(max_size=6))
def test_where_one_part_ends_and_the_next_begins_counts(uid, slot, a, b, c):
    if b:
        assert names.connection_id(uid, slot, a + b, c) != names.connection_id(uid, slot, a, b + c)


def test_an_identifier_is_the_same_in_every_version():
    """It is derived at both ends, which may not be of the same day."""
    made = names.connection_id("0123456789abcdef", 1000, "/plan", "nav_msgs/srv/GetPlan")
    assert made == "16a960f3ea9c6fe1f14eef00d5c778e6"
    key = names.service_key("0123456789abcdef", 1000, "/plan", "nav_msgs/srv/GetPlan")
    assert key == f"fogft/0123456789abcdef/1000/s/{made}"
