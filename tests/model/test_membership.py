"""Who is where: ordered, checked, and never changed by garbage."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.errors import StateError
from fogft.model import membership as memberships
from fogft.model.replica import Member, Membership, ReplicaId
from fogft.model.spec import PoolSpec
from tests.planning.pool_worlds import STRANGER, UID, replica

members = st.lists(
    st.builds(
        Member,
        st.builds(ReplicaId, st.just(UID), st.integers(0, 5), st.integers(1, 5)),
        st.sampled_from(["10.0.0.1:7447", "host:1", "[::1]:65535"]),
        st.booleans(),
    ),
    unique_by=lambda m: m.id,
    max_size=5,
).map(tuple)
revoked = st.frozensets(
    st.builds("robot.{}.{}.{}".format, st.sampled_from("ab"), st.integers(1, 3), st.just(UID))
)
made = st.builds(
    Membership,
    st.just("pool"),
    st.just(UID),
    st.integers(0, 5),
    st.integers(0, 5),
    members,
    revoked,
)


@given(made)
def test_json_round_trip(membership: Membership) -> None:
    """What is written is what is read, through text too."""
    text = json.dumps(memberships.to_dict(membership))
    assert memberships.from_dict(json.loads(text)) == membership


@given(made, st.data())
def test_any_damage_is_an_error(membership: Membership, data: st.DataObject) -> None:
    """One changed, missing or foreign value is noticed; it never becomes another membership."""
    raw = memberships.to_dict(membership)
    key = data.draw(st.sampled_from(sorted(raw)))
    junk = data.draw(st.none() | st.integers(6, 9) | st.text() | st.lists(st.integers()))
    if raw[key] == junk:
        return
    with pytest.raises(StateError):
        memberships.from_dict({**raw, key: junk})
    with pytest.raises(StateError):
        memberships.from_dict({k: v for k, v in raw.items() if k != key})


@pytest.mark.parametrize("junk", [None, 1, "x", [], {}, {"checksum": "0"}])
def test_garbage_is_an_error(junk: object) -> None:
    """Whatever stands in the file, the reader gets a StateError."""
    with pytest.raises(StateError):
        memberships.from_dict(junk)


@pytest.mark.parametrize("endpoint", ["host", ":1", "host:", "host:0", "host:65536", "h:x"])
def test_endpoint_must_be_one(endpoint: str) -> None:
    """A checksum that fits does not make an address of what is none."""
    id = ReplicaId(UID, 0, 1)
    raw = memberships.to_dict(Membership("pool", UID, 1, 1, (Member(id, endpoint),)))
    with pytest.raises(StateError):
        memberships.from_dict(raw)


def test_replica_listed_twice_is_an_error() -> None:
    """One replica, one endpoint."""
    twice = (Member(ReplicaId(UID, 0, 1), "h:1"), Member(ReplicaId(UID, 0, 1), "h:2"))
    with pytest.raises(StateError, match="twice"):
        memberships.from_dict(memberships.to_dict(Membership("pool", UID, 1, 1, twice)))


@given(made, made)
def test_order_is_strict_and_total(one: Membership, other: Membership) -> None:
    """Of two memberships of one pool at most one replaces the other; equals never do."""
    newer, older = memberships.is_newer(one, other), memberships.is_newer(other, one)
    assert not (newer and older)
    same = (one.epoch, one.version) == (other.epoch, other.version)
    assert (newer or older) is not same


@given(made, st.integers(0, 6), members)
def test_successor_is_newer_or_nothing(
    current: Membership, epoch: int, new: tuple[Member, ...]
) -> None:
    """A manager in office writes only what is newer; one out of office writes nothing."""
    after = memberships.successor(current, Membership("pool", UID, epoch, 1, new))
    if epoch < current.epoch:
        assert after is None
    elif after is None:
        assert new == current.members
    else:
        assert memberships.is_newer(after, current)
        assert after.members == new


def test_a_new_manager_shows_itself_even_if_nothing_changed() -> None:
    """A higher epoch is written once, so that proxies fence off the old manager."""
    current = Membership("pool", UID, 1, 5, ())
    after = memberships.successor(current, Membership("pool", UID, 2, 1, ()))
    assert after == Membership("pool", UID, 2, 1, ())


def test_another_pools_membership_never_wins() -> None:
    """Not even with a higher epoch."""
    assert not memberships.is_newer(
        Membership("pool", STRANGER, 9, 9), Membership("pool", UID, 1, 1)
    )


def test_members_are_those_to_talk_to() -> None:
    """Known endpoint, ours, not failed, not ending; marked when they are to go."""
    machines = [
        replica(0).machine,
        replica(1, state="noticed").machine,
        replica(2).machine,
        replica(3).machine,
        replica(4, state="failed").machine,
    ]
    found = memberships.members_of(
        machines, PoolSpec(), pool_uid=UID, draining=[machines[2].id], ending=[machines[3].id]
    )
    assert [(m.id.short, m.draining) for m in found] == [
        ("0.1", False),
        ("1.1", True),
        ("2.1", True),
    ]


@given(made, st.integers(0, 6), members, revoked)
def test_a_revocation_is_never_taken_back(
    current: Membership, epoch: int, new: tuple[Member, ...], more: frozenset[str]
) -> None:
    """Whoever writes next, with whatever in mind: what was revoked stays revoked."""
    after = memberships.successor(current, Membership("pool", UID, epoch, 1, new, more))
    if after is not None:
        assert after.revoked == current.revoked | more
    else:
        assert epoch < current.epoch or (more <= current.revoked and new == current.members)


@pytest.mark.parametrize("name", [f"robot.a.1.{STRANGER}", "robot", 7, None])
def test_a_name_of_nobody_in_the_pool_cannot_be_revoked(name: object) -> None:
    raw = memberships.to_dict(Membership("pool", UID, 1, 1))
    raw["revoked"] = [name]
    del raw["checksum"]
    with pytest.raises(StateError):
        memberships.from_dict({**raw, "checksum": memberships.checksum(raw)})


def test_replicas_started_by_hand_are_members_that_say_where_they_are() -> None:
    """The highest generation of each slot, and never in the place of a machine."""
    machine = replica(100).machine
    by_hand = [ReplicaId(UID, 101, 1), ReplicaId(UID, 101, 3), ReplicaId(UID, 100, 9)]
    found = memberships.members_of([machine], PoolSpec(), pool_uid=UID, by_hand=by_hand)
    assert [member.id for member in found] == [machine.id, ReplicaId(UID, 101, 3)]
    assert found[1] == Member(ReplicaId(UID, 101, 3), "")
