"""Slots of 100 and more: those of groups, and those that people start by hand, 2000 and above."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft import disk
from fogft.cli import output, status_text
from fogft.cloud.local.folder import MachineFolder
from fogft.cloud.sky import naming
from fogft.doctor import pools
from fogft.errors import FogftError
from fogft.model import membership, names
from fogft.model.credentials import Role, holder_of
from fogft.model.groups import FIRST_BY_HAND, LAST_BY_HAND
from fogft.model.plain import to_plain
from fogft.model.replica import LinkReport, LinkState, Member, Membership, ReplicaId
from fogft.model.spec import GroupSpec
from fogft.pool.commands import change
from fogft.pool.commands.status import Seen, slots
from fogft.pool.credentials import authority
from fogft.pool.credentials.ledger import Ledger
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import Identity
from fogft.pool.manager import configuration, proxy_report, status
from fogft.pool.manager.reconciler import Tick
from fogft.pool.manager.status import ReplicaStatus
from tests.planning.pool_worlds import NOW, SERVICE, UID, World, replica, spec

HIGH = st.integers(100, LAST_BY_HAND)
SOME = (0, 9, 10, 99, 100, 105, 1999, 2000, 2010, LAST_BY_HAND)
IDENTITY = Identity("pool", UID, "mock", "/pool.yaml", NOW)


def id_of(slot: int, generation: int = 1) -> ReplicaId:
    return ReplicaId(UID, slot, generation)


@given(HIGH, st.integers(1, 999_999))
def test_every_name_of_a_replica_gives_its_id_back(slot: int, generation: int) -> None:
    """Certificates, clusters, folders, memberships; none is cut short or longer than allowed."""
    id = id_of(slot, generation)
    common_name = id.certificate_name
    assert len(common_name) <= 64
    holder = holder_of(common_name)
    assert (holder.role, int(holder.name), holder.generation) == (Role.REPLICA, slot, generation)
    assert naming.replica_of(naming.cluster_name(id)) == id
    folder = MachineFolder.at(Path("machines") / str(id))
    assert folder is not None
    assert folder.id == id
    wanted = Membership("pool", UID, 1, 1, (Member(id, "h:1"),))
    assert membership.from_dict(membership.to_dict(wanted)) == wanted


def test_slots_have_connections_and_keys_of_their_own() -> None:
    """Below all gateways' slots."""
    keys = {names.service_key(UID, slot, "/plan", "T") for slot in SOME}
    keys |= {names.slot_key(UID, slot, names.PROBE) for slot in SOME}
    assert len(keys) == 2 * len(SOME)
    assert max(SOME) < names.GATEWAY_SLOTS <= names.gateway_slot("edge")


def test_ids_sort_by_number() -> None:
    shuffled = [id_of(slot, generation) for slot in reversed(SOME) for generation in (10, 9)]
    assert [(id.slot, id.generation) for id in sorted(shuffled)] == [
        (slot, generation) for slot in SOME for generation in (9, 10)
    ]


# -- the manager --------------------------------------------------------------------------------


def test_a_groups_machines_are_not_taken_for_replicas_by_hand(tmp_path: Path) -> None:
    """Their slots are 100 and more, and their certificates outlive them by far."""
    authority.create_authority(tmp_path / "ca", UID)
    ledger = Ledger(tmp_path / "ca")
    for slot in SOME:
        ledger.issue(holder_of(id_of(slot).certificate_name))
    assert ledger.by_hand() == {id_of(slot) for slot in SOME if slot >= FIRST_BY_HAND}


GROUPS = tuple(GroupSpec(name, 2) for name in ("small", "large"))


@given(st.lists(st.sampled_from(["ready", "silent", "starting"]), min_size=4, max_size=4))
def test_the_planner_is_not_moved_by_what_runs_by_hand(states: list[str]) -> None:
    """Links to slots that no machine has change neither who is launched nor who is ended."""
    wanted = spec(4, groups=GROUPS)
    parts = [replica(s, of=wanted, state=state) for s, state in zip((0, 1, 200, 201), states)]  # noqa: B905
    world = World(wanted).having(*parts)
    by_hand = LinkReport(id_of(2000), LinkState.UP, ready=frozenset({SERVICE.name}))
    moved = replace(world, links=(*(world.links or ()), by_hand))
    if "ready" in states:
        assert world.plan() == moved.plan()
    ours = {part.machine.id for part in parts}
    assert {end.id for end in moved.plan().terminations} <= ours
    assert all(launch.slot < FIRST_BY_HAND for launch in moved.plan().launches)


def test_a_replica_by_hand_has_its_own_port_for_metrics() -> None:
    """Its machine is its own; those of the manager may share an address, and add their slots."""
    metrics = replace(spec().metrics, replica="127.0.0.1:64000")
    text = {
        slot: configuration.replica_config(IDENTITY, spec(metrics=metrics), id_of(slot))
        for slot in (105, 2000, LAST_BY_HAND)
    }
    assert "127.0.0.1:64105" in text[105]
    assert "127.0.0.1:64000" in text[2000]
    assert "127.0.0.1:64000" in text[LAST_BY_HAND]


# -- what people see ----------------------------------------------------------------------------


def seen() -> status.PoolStatus:
    """Return the status of a pool with groups and two replicas by hand, one not found yet."""
    wanted = spec(4, groups=GROUPS)
    world = World(wanted).having(*(replica(slot, of=wanted) for slot in (0, 1, 200, 201)))
    up = LinkReport(
        id_of(2000, 2), LinkState.UP, ready=frozenset({SERVICE.name}), rtt_s=0.004, won=7
    )
    world = replace(world, links=(*(world.links or ()), up))
    listed = [*(machine.id for machine in world.machines or ()), id_of(2000, 2), id_of(2001)]
    admitted = Membership("pool", UID, 1, 1, tuple(Member(id, "") for id in listed))
    tick = Tick(IDENTITY, wanted, world.intent, world.observed, world.plan(), admitted)
    report = proxy_report.ProxyReport(7, NOW)
    found = status.of_tick(tick, history=world.history, recent=[])
    return found.joined(report, proxy_alive=True, links=world.observed.links)


def test_status_shows_replicas_by_hand_beside_the_managers(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They count for what a service can do, and for no number of what the pool wants."""
    monkeypatch.delenv("COLUMNS", raising=False)
    found = seen()
    assert (found.target, found.ready, found.services[0].ready_replicas) == (4, 4, 5)
    assert [one.slot for one in found.replicas] == [0, 1, 200, 201]
    assert [(one.slot, one.phase, one.link) for one in found.by_hand] == [
        (2000, "ready", "up"),
        (2001, "starting", ""),
    ]
    assert status.from_json(to_plain(found), Path("status.json")) == found
    output.show(status_text.rendered(Seen(found, 0.4, True), width=100))
    lines = capsys.readouterr().out.splitlines()
    first = next(n for n, line in enumerate(lines) if line.startswith("REPLICA"))
    table = lines[first : first + 7]
    assert [line.split()[0] for line in table[1:]] == [
        "0.1", "1.1", "200.1", "201.1", "2000.2", "2001.1",
    ]  # fmt: skip
    assert len({line.index(word) for line, word in zip(table, ["PHASE"] + 5 * ["ready"])}) == 1  # noqa: B905
    assert table[5].split()[1:] == ["ready", "by", "hand", "0.000", "up", "4.00", "ms", "7", "-"]
    assert "it has not been found yet" in "\n".join(lines)


def test_the_doctor_does_not_promise_to_replace_what_was_started_by_hand() -> None:
    rows = [ReplicaStatus(slot, 2, "ready", link="suspect") for slot in (2000, 105)]
    silent = replace(seen(), proxy_alive=True, replicas=rows[1:], by_hand=rows[:1])
    [launched, by_hand, _] = pools.judge_links("p", Seen(silent, 0.0, manager_alive=True))
    assert "replica `2000.2` is suspect" in by_hand.text
    assert "replica `105.2` is suspect" in launched.text
    assert "is not replaced automatically" in by_hand.advice
    assert "`fogft logs 105`" in launched.advice


def test_slots_are_listed_by_number(tmp_path: Path) -> None:
    """In hints and lists: 9 before 10, and 99 before 100."""
    rows = [replace(seen().replicas[0], slot=slot) for slot in (100, 9, 10, 99)]
    disk.write_json(PoolPaths(tmp_path).status, to_plain(replace(seen(), replicas=rows)))
    with pytest.raises(FogftError) as caught:
        change.generation_in(PoolPaths(tmp_path), 5, NOW)
    assert caught.value.hint == "slots in use: 9, 10, 99, 100"
    with pytest.raises(FogftError, match="started manually") as caught:
        change.generation_in(PoolPaths(tmp_path), 2000, NOW)
    assert "`fogft credentials revoke replica 2000`" in caught.value.hint
    assert slots(PoolPaths(tmp_path)) == [9, 10, 99, 100]
