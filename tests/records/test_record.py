"""Laws of records: one writer, one order, nothing older wins, and no bytes break a reader."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model import plain
from fogft.model.names import is_endpoint
from fogft.model.replica import Member, Membership, ReplicaId
from fogft.records.record import (
    BODY_LIMIT,
    Record,
    RecordError,
    RecordKind,
    SignedRecord,
    from_plain,
    read_body,
    sign_record,
    to_plain,
)
from fogft.records.record_set import RecordSet, Verdict
from fogft.records.roster import SlotState, admission, located, slot_state
from tests.records import certificate_names
from tests.records import record_worlds as world
from tests.records.record_worlds import UID, records, verify


def merged(*offered: SignedRecord, limit: int = 1024) -> RecordSet:
    out = RecordSet(UID, verify, limit=limit)
    for one in offered:
        out.offer(one)
    return out


def bodies(found: RecordSet) -> set[bytes]:
    return {one.body for one in found.lacking({})}


# -- merging ------------------------------------------------------------------------------------


@given(
    st.lists(records, max_size=12).flatmap(
        lambda all: st.tuples(st.just(all), st.permutations(all))
    )
)
def test_the_order_of_arrival_does_not_matter(both):
    """Two that heard the same records, in whatever order and however often, hold the same."""
    one, other = both
    assert bodies(merged(*one)) == bodies(merged(*other, *one))


@given(st.lists(records, max_size=12))
def test_nothing_older_ever_wins(offered):
    """For each key what stands is never replaced by a lower (generation, sequence)."""
    held = RecordSet(UID, verify)
    for one in offered:
        before = held.digest()
        held.offer(one)
        after = held.digest()
        assert all(after[key] >= order for key, order in before.items())


@given(st.lists(records, max_size=10), st.lists(records, max_size=10))
def test_two_that_exchange_what_the_other_lacks_hold_the_same(mine, theirs):
    """One digest and one answer each way suffice, unless a writer contradicted itself."""
    a, b = merged(*mine), merged(*theirs)
    for_b, for_a = a.lacking(b.digest()), b.lacking(a.digest())
    for one in for_b:
        b.offer(one)
    for one in for_a:
        a.offer(one)
    assert a.digest() == b.digest()


def test_what_was_replayed_changes_nothing_and_is_counted():
    old, new = world.admission(1, 1), world.admission(2, 1, world.member(0, 1, "h:1"))
    held = merged(old, new)
    before = bodies(held)
    assert held.offer(old) is Verdict.OLDER
    assert held.offer(new) is Verdict.KNOWN
    assert bodies(held) == before
    assert held.counts == {"accepted": 2, "older": 1, "known": 1}


def test_a_writer_that_contradicts_itself_is_settled_alike_everywhere():
    """Two bodies under one number: all come to hold the same one of them."""
    one = world.slot(0, 1, 1, SlotState(endpoint="a:1"))
    two = world.slot(0, 1, 1, SlotState(endpoint="b:1"))
    assert bodies(merged(one, two)) == bodies(merged(two, one))


# -- who may write what -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("role", "common_name"),
    [
        ("replica", ReplicaId(UID, 1, 5).certificate_name),  # another slot
        ("replica", ReplicaId(UID, 0, 4).certificate_name),  # an older launch
        ("robot", ReplicaId(UID, 0, 5).certificate_name),  # the right name only
        ("robot", certificate_names.robot(UID, "r")),
        ("manager", certificate_names.manager(UID)),
        ("rendezvous", certificate_names.rendezvous(UID, "a")),
    ],
)
def test_a_slot_is_written_by_its_own_launch_only(role, common_name):
    """Not by its neighbour, its predecessor, a robot, nor the manager."""
    record = Record(UID, RecordKind.SLOT, "0", 5, 1, plain.to_plain(SlotState()))
    held = RecordSet(UID, verify)
    assert held.offer(sign_record(record, world.signer(role, common_name))) is Verdict.REFUSED
    assert held.counts["refused_writer"] == 1
    assert len(held) == 0


@pytest.mark.parametrize("kind", [RecordKind.ADMISSION, RecordKind.LEASE, RecordKind.REVOCATION])
def test_only_the_manager_admits_and_revokes(kind):
    content = {"pool": "p", "members": [], "names": [], "at": 1.0, "lasts_s": 60.0}
    record = Record(UID, kind, "", 9, 9, content)
    held = merged(world.signed(record))
    assert held.get(kind).record == record
    newer = replace(record, sequence=10)
    for role, name in [
        ("replica", ReplicaId(UID, 0, 1).certificate_name),
        ("robot", certificate_names.manager(UID)),
        ("gateway", certificate_names.gateway(UID, "g")),
    ]:
        assert held.offer(sign_record(newer, world.signer(role, name))) is Verdict.REFUSED
    assert held.get(kind).record == record


def test_a_changed_body_is_forged_and_another_pools_is_refused():
    good = world.slot(0, 1, 1)
    held = RecordSet(UID, verify)
    changed = good.body.replace(b'"sequence":1', b'"sequence":2')
    assert held.offer(replace(good, body=changed)) is Verdict.REFUSED
    other = good.body.replace(UID.encode(), UID[::-1].encode())
    assert held.offer(replace(good, body=other)) is Verdict.REFUSED
    assert held.counts == {"refused_forged": 1, "refused_pool": 1}
    assert len(held) == 0


def test_revocation_takes_back_what_was_signed_and_admits_no_more():
    """The next launch of the slot has a name of its own, and is let in."""
    bad = ReplicaId(UID, 0, 1).certificate_name
    held = merged(world.slot(0, 1, 1), world.slot(1, 1, 1))
    held.offer(world.revocation(1, bad))
    assert [r.subject for r in held.of(RecordKind.SLOT)] == ["1"]
    assert held.offer(world.slot(0, 1, 2)) is Verdict.REFUSED
    assert held.counts["refused_revoked"] == 1
    assert held.offer(world.slot(0, 2, 1)) is Verdict.ACCEPTED
    assert held.revoked == {bad}


@pytest.mark.parametrize("listed", [None, "x", ["x"], [7], [f"robot.r.1.{UID[::-1]}"]])
def test_a_revocation_of_what_is_no_name_of_the_pool_is_refused(listed):
    record = Record(UID, RecordKind.REVOCATION, "", 1, 1, {"names": listed})
    held = RecordSet(UID, verify)
    assert held.offer(world.signed(record)) is Verdict.REFUSED
    assert held.counts["refused_malformed"] == 1


def test_a_rotated_robot_writes_its_next_generation():
    """And nobody writes under a generation that the certificate does not name."""
    record = Record(UID, RecordKind.ROBOT, "r", 2, 1, {"dial_in": ""})
    old = world.signer("robot", certificate_names.robot(UID, "r"))
    new = world.signer("robot", certificate_names.robot(UID, "r", 2))
    held = RecordSet(UID, verify)
    assert held.offer(sign_record(record, old)) is Verdict.REFUSED
    assert held.offer(sign_record(record, new)) is Verdict.ACCEPTED


def test_there_is_a_limit_to_keys_but_not_to_news_of_known_ones():
    held = merged(*(world.slot(n, 1, 1) for n in range(5)), limit=3)
    assert len(held) == 3
    assert held.counts["refused_full"] == 2
    assert held.offer(world.slot(0, 1, 2)) is Verdict.ACCEPTED


# -- bytes --------------------------------------------------------------------------------------


@given(records)
def test_a_record_survives_its_travels(one):
    again = from_plain(json.loads(json.dumps(to_plain(one))))
    assert again == one
    record = read_body(again)
    assert world.signed(record).body == one.body


@given(st.binary(max_size=300))
def test_random_bytes_are_no_record(raw):
    held = RecordSet(UID, verify)
    assert held.offer(SignedRecord(raw, b"", b"")) is Verdict.REFUSED
    assert held.counts["refused_malformed"] + held.counts["refused_version"] == 1


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=8,
)


@given(
    records,
    st.sampled_from(["v", "pool", "kind", "subject", "generation", "sequence", "content"]),
    JSON,
)
def test_a_record_with_one_odd_value_is_judged_like_any_other(one, key, odd):
    """It is a good record by luck, or `RecordError`; an odd content changes no state."""
    raw = json.loads(one.body)
    raw[key] = odd
    try:
        body = json.dumps(raw).encode()
    except ValueError:
        return
    held = RecordSet(UID, verify)
    verdict = held.offer(SignedRecord(body, b"replica|x|1", b"unsigned"))
    assert verdict is Verdict.REFUSED
    assert len(held) == 0


@given(JSON, records)
def test_odd_contents_from_the_right_writer_are_refused_or_usable(content, one):
    """Whatever a writer puts into its own record, the roster can be made of what was accepted."""
    record = read_body(one)
    if not isinstance(content, dict):
        content = {**record.content, "members": content, "endpoint": content, "services": content}
    try:
        odd = world.signed(replace(record, content=content))
    except ValueError:
        return  # not even its writer can encode it
    held = merged(odd, world.admission(5, 5, world.member(0, 1)))
    membership = admission(held.get(RecordKind.ADMISSION).record)
    assert located(membership, held.of(RecordKind.SLOT)).pool_uid == UID


@given(JSON)
def test_odd_plain_data_is_no_signed_record(raw):
    with pytest.raises(RecordError):
        from_plain(raw)


def test_versions_sizes_and_nesting_are_limited():
    held = RecordSet(UID, verify)
    good = world.slot(0, 1, 1)
    for body, reason in [
        (good.body.replace(b'"v":2', b'"v":3'), "version"),
        (good.body.replace(b'"v":2', b'"v":true'), "version"),
        (good.body[:-7], "malformed"),
        (good.body + b" " * BODY_LIMIT, "malformed"),
        (b"[" * 60_000, "malformed"),
        (b'{"v":' * 12_000, "malformed"),
        (good.body.replace(b'"sequence":1', b'"sequence":NaN'), "malformed"),
        (good.body.replace(b'"sequence":1', b'"sequence":' + b"9" * 30), "malformed"),
        (good.body.replace(b'"subject":"0"', b'"subject":"00"'), "malformed"),
    ]:
        before = held.counts[f"refused_{reason}"]
        assert held.offer(replace(good, body=body)) is Verdict.REFUSED
        assert held.counts[f"refused_{reason}"] == before + 1
    assert len(held) == 0


# -- what follows -------------------------------------------------------------------------------


@given(world.states, world.endpoints, st.integers(1, 3))
def test_only_the_admitted_generation_says_where_it_is(state, endpoint, generation):
    """A record of a launch before or after the admitted one moves nobody."""
    membership = Membership("p", UID, 1, 1, (world.member(0, 2, endpoint),))
    record = read_body(world.slot(0, generation, 1, state))
    assert slot_state(record) == state
    found = located(membership, [record]).members[0]
    if generation != 2:
        assert found == membership.members[0]
    elif state.dials_out:
        assert found.endpoint == ""
    else:
        assert found.endpoint == (state.endpoint or endpoint or state.observed_endpoint)


def test_an_admission_is_a_membership():
    members = (Member(ReplicaId(UID, 0, 3), "10.0.0.1:1", draining=True), world.member(1, 1))
    record = read_body(world.admission(4, 7, *members))
    assert admission(record) == Membership("p", UID, 4, 7, members)


@pytest.mark.parametrize(
    ("text", "good"),
    [
        ("h:1", True), ("10.0.0.1:65535", True), ("[::1]:1", True), ("::1:1", False),
        ("h:0", False), ("h:65536", False), (":1", False), ("h", False), ("h:١", False),
        ("h:00000000001", False),
    ],
)  # fmt: skip
def test_endpoints(text, good):
    assert is_endpoint(text) is good
