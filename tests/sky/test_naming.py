"""Names and labels say whose machine it is, and nothing else passes for ours."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.cloud.sky import naming
from fogft.model.replica import Placement, ReplicaId
from tests.fakes.sky import labels

ids = st.builds(
    ReplicaId,
    pool_uid=st.text("0123456789abcdef", min_size=16, max_size=16),
    slot=st.integers(0, 999_999_999),
    generation=st.integers(1, 999_999_999),
)


@given(ids)
def test_a_name_and_its_labels_give_the_id_back(id: ReplicaId):
    """Whoever finds the machine, by name or by labels, knows whose it is."""
    assert naming.replica_of(naming.cluster_name(id)) == id
    found = labels(id, 0.0213)
    assert naming.replica_of_labels(found) == id
    assert naming.usd_per_hour(found) == 0.0213


@given(ids, ids)
def test_different_replicas_have_different_names(one: ReplicaId, other: ReplicaId):
    """One cluster a generation: a relaunch never meets the record of its predecessor."""
    assert (naming.cluster_name(one) == naming.cluster_name(other)) == (one == other)


@given(st.text())
def test_what_is_not_a_name_of_ours_is_nobodys(text: str):
    """A name that is read as ours is exactly the name that we would have made."""
    id = naming.replica_of(text)
    assert id is None or naming.cluster_name(id) == text


@pytest.mark.parametrize(
    "name",
    [
        "fogft-00000000000000aa-0-01",
        "fogft-00000000000000AA-0-1",
        "fogft-00000000000000aa-0-1-x",
        "fogft-00000000000000aa--1-1",
        "xfogft-00000000000000aa-0-1",
        "fogft-00000000000000aa-0-1\n",
    ],
)
def test_near_misses_are_not_ours(name: str):
    assert naming.replica_of(name) is None


@pytest.mark.parametrize(
    "id", [ReplicaId("x", 0, 1), ReplicaId("00000000000000aa", -1, 1), ReplicaId("", 0, 0)]
)
def test_an_id_that_is_not_ours_has_no_name(id: ReplicaId):
    with pytest.raises(ValueError, match="not a replica's id"):
        naming.cluster_name(id)


@given(st.text(max_size=200))
def test_any_text_becomes_a_label_that_every_cloud_takes(text: str):
    value = naming.label_value(text)
    assert len(value) <= 63
    assert all(c in "abcdefghijklmnopqrstuvwxyz0123456789_-" for c in value)


@pytest.mark.parametrize("price", ["", "x", "-1", "1.5", "²"])
def test_a_price_that_is_not_one_is_nought(price: str):
    assert naming.usd_per_hour({naming.PRICE: price}) == 0.0


def test_a_placement_in_skypilots_words():
    assert naming.infra(Placement("gcp", "us-west1", "", "n2")) == "gcp/us-west1"
    assert naming.infra(Placement("aws", "r", "ra", "m")) == "aws/r/ra"
