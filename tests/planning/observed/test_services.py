"""What replicas told stays offered while they run the same, and is told anew when they do not."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model.replica import LinkReport, LinkState, Machine, MachinePhase, Placement, ReplicaId
from fogft.model.ros_names import is_of_application
from fogft.model.spec import PoolSpec
from fogft.planning.observed.health import is_ready
from fogft.planning.observed.services import Discovered, grown, offered

UID = "0123456789abcdef"
SPEC = PoolSpec("p", (), task={"run": "x"})
maps = st.dictionaries(st.sampled_from(["/a", "/b", "/c"]), st.sampled_from(["a/srv/A", "a/srv/B"]))
hashes = st.sampled_from(["one", "two"])


def machine(slot: int, spec_hash: str = SPEC.replica_hash) -> Machine:
    place = Placement("local", "r", "r-a", "m", spot=True)
    id = ReplicaId(UID, slot, 1)
    return Machine(id, place, MachinePhase.RUNNING, 0.0, "h:1", spec_hash=spec_hash)


def link(slot: int, *services: tuple[str, str], state: LinkState = LinkState.UP) -> LinkReport:
    ready = frozenset(name for name, _ in services)
    return LinkReport(ReplicaId(UID, slot, 1), state, ready, offered=services)


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
        link(0, ("/a", "a/srv/A")),
        link(1, ("/old", "a/srv/A")),
        link(2, ("/gone", "a/srv/A"), state=LinkState.SUSPECT),
    ]
    assert offered(SPEC.replica_hash, machines, links) == {"/a": "a/srv/A"}


def test_a_replica_is_ready_when_it_answers_all_that_was_discovered():
    known = replace(SPEC, discovered=Discovered("", {"/a": "a/srv/A", "/b": "a/srv/B"}).specs())
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
