"""What most replicas told stays offered while they run the same; later it is told anew."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model.replica import (
    LinkReport,
    LinkState,
    Machine,
    MachinePhase,
    Observed,
    Placement,
    ReplicaId,
)
from fogft.model.ros_names import is_of_application
from fogft.model.spec import PoolSpec
from fogft.planning.observed.health import is_ready
from fogft.planning.observed.services import Discovered, claims, grown

UID = "0123456789abcdef"
SPEC = PoolSpec("p", (), task={"run": "x"})
maps = st.dictionaries(st.sampled_from(["/a", "/b", "/c"]), st.sampled_from(["a/srv/A", "a/srv/B"]))
pairs = st.tuples(st.sampled_from(["/a", "/b", "/c"]), st.just("a/srv/A"))
hashes = st.sampled_from(["one", "two"])

A = ("/a", "a/srv/A")


def machine(slot: int, spec_hash: str = SPEC.replica_hash) -> Machine:
    place = Placement("local", "r", "r-a", "m", spot=True)
    id = ReplicaId(UID, slot, 1)
    return Machine(id, place, MachinePhase.RUNNING, 0.0, "h:1", spec_hash=spec_hash)


def link(slot: int, *services: tuple[str, str], state: LinkState = LinkState.UP) -> LinkReport:
    ready = frozenset(name for name, _ in services)
    return LinkReport(ReplicaId(UID, slot, 1), state, ready, offered=services)


def observed(machines: list[Machine], links: list[LinkReport]) -> Observed:
    return Observed(0.0, tuple(machines), tuple(links))


@given(hashes, maps, hashes, maps)
def test_no_name_is_lost_while_the_replicas_run_the_same(h1, before, h2, now):
    known = Discovered(h1, before)
    after = grown(known, h2, now)
    if h1 == h2 or not now:
        assert before.items() <= after.services.items()
    else:
        assert (after.spec_hash, after.services) == (h2, now)


@given(hashes, maps)
def test_nothing_told_changes_nothing(spec_hash, before):
    """All replicas died: what they offered is still what the robot may ask for."""
    known = Discovered("one", before)
    assert grown(known, spec_hash, {}) == known


def test_only_replicas_that_are_up_and_run_the_present_file_are_heard():
    machines = [machine(0), machine(1, "older"), machine(2)]
    links = [
        link(0, A),
        link(1, ("/old", "a/srv/A")),
        link(2, ("/gone", "a/srv/A"), state=LinkState.SUSPECT),
    ]
    told = claims(Discovered(), SPEC.replica_hash, observed(machines, links), 3)
    assert (told.count, told.voters) == ({A: 1}, 2)


@given(st.integers(3, 9), st.sets(pairs, min_size=1), st.sets(pairs), st.booleans(), st.data())
def test_one_replicas_word_changes_nothing(count, honest, lies, begun, data):
    """Neither what is offered, nor who is ready: whatever it claims, or does not claim."""
    liar = data.draw(st.integers(0, count - 1))
    known = Discovered(SPEC.replica_hash, dict(honest)) if begun else Discovered()
    links = [link(slot, *(lies if slot == liar else honest)) for slot in range(count)]
    machines = [machine(slot) for slot in range(count)]
    told = claims(known, SPEC.replica_hash, observed(machines, links), count)
    after = grown(known, SPEC.replica_hash, told.agreed())
    assert after == Discovered(SPEC.replica_hash, dict(honest))
    spec = replace(SPEC, discovered=after.specs(), discovered_by=after.spec_hash)
    ready = [is_ready(spec, *one) for one in zip(machines, links, strict=True)]
    assert all(ready[slot] for slot in range(count) if slot != liar)


@given(st.integers(2, 9), pairs)
def test_one_that_is_left_alone_cannot_add_a_name(wanted, lie):
    """The others were preempted: what is known stays, and is all that there is."""
    known = Discovered(SPEC.replica_hash, {"/known": "a/srv/A"})
    told = claims(known, SPEC.replica_hash, observed([machine(0)], [link(0, lie)]), wanted)
    assert told.agreed() == {}
    assert told.outvoted() == [lie[0]]


def test_where_no_other_machine_can_be_had_the_first_one_decides():
    """A pool for two that gets one machine for a day answers all the same."""
    told = claims(Discovered(), SPEC.replica_hash, observed([machine(0)], [link(0, A)]), 2)
    assert told.agreed() == dict([A])


def test_a_changed_file_begins_anew_once_most_of_its_replicas_have_told():
    """Until then the first ones need answer what they offer, and replace old ones one by one."""
    known = Discovered("older", {"/old": "a/srv/A"})
    spec = replace(SPEC, discovered=known.specs(), discovered_by="older")
    machines = [machine(0), machine(1, "older"), machine(2, "older")]
    old = [link(slot, ("/old", "a/srv/A")) for slot in (1, 2)]
    told = claims(known, spec.replica_hash, observed(machines, [link(0, A), *old]), 3)
    assert grown(known, spec.replica_hash, told.agreed()) == known
    assert is_ready(spec, machines[0], link(0, A))
    machines[1] = machine(1)
    told = claims(known, spec.replica_hash, observed(machines, [link(0, A), link(1, A), old[1]]), 3)
    assert grown(known, spec.replica_hash, told.agreed()) == Discovered(
        SPEC.replica_hash, dict([A])
    )


def test_only_what_is_below_the_pools_namespace_is_offered():
    known = Discovered("", {"/arm/plan": "a/srv/A", "/arms": "a/srv/A", "/robot/stop": "a/srv/A"})
    assert [one.name for one in known.specs("/arm")] == ["/arm/plan"]
    assert len(known.specs()) == 3


def test_a_replica_is_ready_when_it_answers_all_that_was_discovered():
    known = replace(
        SPEC,
        discovered=Discovered("", {"/a": "a/srv/A", "/b": "a/srv/B"}).specs(),
        discovered_by=SPEC.replica_hash,
    )
    half, whole = link(0, ("/a", "a/srv/A")), link(0, ("/a", "a/srv/A"), ("/b", "a/srv/B"))
    assert not is_ready(SPEC, machine(0), half)  # nothing is known yet
    assert not is_ready(known, machine(0), half)
    assert is_ready(known, machine(0), whole)


@pytest.mark.parametrize(
    ("name", "kind", "own"),
    [
        ("/detect", "my_msgs/srv/Detect", True),
        ("/arm/plan", "std_srvs/srv/Trigger", True),
        ("/n/get_parameters", "rcl_interfaces/srv/GetParameters", False),
        ("/n/get_logger_levels", "rcl_interfaces/srv/GetLoggerLevels", False),
        ("/n/get_type_description", "type_description_interfaces/srv/GetTypeDescription", False),
        ("/n/change_state", "lifecycle_msgs/srv/ChangeState", False),
        ("/fly/_action/send_goal", "a/srv/Fly_SendGoal", False),
        ("/c/_container/load_node", "composition_interfaces/srv/LoadNode", False),
    ],
)
def test_services_of_ros_itself_are_not_an_applications(name, kind, own):
    assert is_of_application(name, kind) is own
