"""`state` in a pool file: what it means, what it becomes, and how mistakes are told."""

from __future__ import annotations

import pytest

from fogft.errors import FogftError, SpecError
from fogft.model.intent import Intent, scale
from fogft.model.plain import from_plain, to_plain
from fogft.model.spec import ServiceSpec
from fogft.model.state import StateService, StateSpec
from fogft.poolfile import file as pool_file
from fogft.poolfile.pool import Checks

FILE = """
name: p
run: exec serve
fogft:
  services:
    - name: /count
      type: std_srvs/srv/SetBool
"""
SHORT = "{snapshot: /count/get_state, restore: count/set_state}"
LONG = (
    "{snapshot: {name: /a, type: my_msgs/srv/GetState, field: state.data},"
    " restore: {name: /b, type: my_msgs/srv/SetState, field: data}}"
)


def parse(state: str, more: str = "", **checks):
    return pool_file.parse(
        f"{FILE}      state: {state}\n{more}", file="p.yaml", checks=Checks(**checks)
    )


def test_names_alone_stand_for_the_types_of_the_helpers():
    (service,) = parse(SHORT).services
    assert service.state == StateSpec(
        StateService("/count/get_state", "nav_msgs/srv/GetMap", "map.data"),
        StateService("/count/set_state", "nav_msgs/srv/SetMap", "map.data"),
    )


def test_any_types_and_fields_can_be_named():
    (service,) = parse(LONG).services
    assert service.state == StateSpec(
        StateService("/a", "my_msgs/srv/GetState", "state.data"),
        StateService("/b", "my_msgs/srv/SetState", "data"),
    )


@pytest.mark.parametrize("state", [SHORT, LONG])
def test_both_proxies_read_what_is_written(state):
    (service,) = parse(state).services
    assert from_plain(ServiceSpec, to_plain(service)) == service


def test_running_replicas_are_replaced_when_a_service_becomes_stateful():
    plain = pool_file.parse(FILE, file="p.yaml")
    assert plain.replica_hash != parse(SHORT).replica_hash != parse(LONG).replica_hash


@pytest.mark.parametrize(
    ("state", "key", "what", "hint"),
    [
        ("[]", "state", "must be a map", "get_state"),
        ("{snapshot: /a}", "state.restore", "is missing", "set_state"),
        ("{snapshot: /a, restor: /b}", "state.restor", "unknown key", "restore"),
        ("{snapshot: /a b, restore: /b}", "state.snapshot", "is not a service name", "/svc"),
        (
            "{snapshot: /a, restore: /b, shared: true}",
            "state.shared",
            "one robot",
            "docs/how-to/state.md",
        ),
        ("{snapshot: 3, restore: /b}", "state.snapshot", "must be text", "quotes"),
        ("{snapshot: {name: /a, type: x/srv/A}, restore: /b}", "field", "is missing", "type"),
        ("{snapshot: {name: /a, field: x}, restore: /b}", "type", "is missing", "type"),
        (
            "{snapshot: {name: /a, type: x.A, field: d}, restore: /b}",
            "snapshot.type",
            "is not a service type",
            "x/srv/A",
        ),
        (
            "{snapshot: {name: /a, type: x/srv/A, field: a..b}, restore: /b}",
            "snapshot.field",
            "is not the path of a field",
            "map.data",
        ),
    ],
)
def test_mistakes_name_line_key_and_remedy(state, key, what, hint):
    with pytest.raises(SpecError) as caught:
        parse(state)
    message = caught.value.message
    assert message.startswith("p.yaml:8: ")
    assert key in message
    assert what in message
    assert hint in caught.value.hint


@pytest.mark.parametrize("line", ["ok_field: success", "hedging: failover"])
def test_what_does_not_go_with_state_is_refused(line):
    with pytest.raises(SpecError, match="cannot be combined with `state`"):
        parse(SHORT, f"      {line}\n")


def test_types_are_judged_where_they_can_be():
    with pytest.raises(SpecError, match=r"p.yaml:8: fogft.services\[0\].state: no such field"):
        parse(SHORT, states=lambda state: SpecError("no such field", "name another"))


VOTING = FILE + "      quorum: 2\n"


def test_a_quorum_and_its_tolerances_reach_the_client_proxy():
    (service,) = pool_file.parse(
        VOTING + "      tolerance: {plan.cost: 0.5, x: 1}\n", file="p.yaml"
    ).services
    assert (service.quorum, service.tolerance) == (2, {"plan.cost": 0.5, "x": 1.0})
    assert from_plain(ServiceSpec, to_plain(service)) == service


@pytest.mark.parametrize(
    ("file", "what"),
    [
        (VOTING + "      ok_field: success\n", "cannot be combined with `quorum`"),
        (VOTING + "      hedging: failover\n", "cannot be combined with `quorum`"),
        (VOTING + f"      state: {SHORT}\n", "cannot be combined with `state`"),
        (FILE + "      tolerance: {x: 1}\n", "has no effect here"),
        (VOTING + "      tolerance: {a..b: 1}\n", "is not the path of a field"),
        (VOTING + "      tolerance: {x: 0}\n", "must be above 0"),
        (VOTING + "      tolerance: 3\n", "must be a map"),
        (FILE + "      quorum: 1\n", "must be from 2 to 100"),
    ],
)
def test_mistakes_with_a_quorum_are_told(file, what):
    with pytest.raises(SpecError, match=what):
        pool_file.parse(file, file="p.yaml")


WINDOW = "  schedule: {time_zone: UTC, windows: [{days: mon, replicas: %d}]}\n"


@pytest.mark.parametrize(
    ("more", "fewest"),
    [
        ("      quorum: 3\n", 2),
        ("      quorum: 3\n  replicas: 2\n", 2),
        ("      quorum: 2\n  availability: 0.99\n", 1),
        ("      quorum: 2\n  groups: [{name: a, replicas: 1}]\n", 1),
        ("      quorum: 3\n  replicas: 4\n" + WINDOW % 2, 2),
    ],
)
def test_a_quorum_that_cannot_be_reached_is_refused(more, fewest):
    """No answer could win, ever or at some time: that is said with file, line and key."""
    expected = rf"p.yaml:8: fogft.services\[0\].quorum: is \d, but only {fewest} can be asked"
    with pytest.raises(SpecError, match=expected) as refused:
        pool_file.parse(FILE + more, file="p.yaml")
    assert "a smaller `quorum`" in refused.value.hint


@pytest.mark.parametrize(
    "more",
    [
        "      quorum: 2\n",
        "      quorum: 3\n  replicas: 3\n" + WINDOW % 4,
        "      quorum: 2\n  replicas: 2\n  availability: 0.99\n",
    ],
)
def test_a_quorum_that_can_be_reached_is_taken(more):
    assert pool_file.parse(FILE + more, file="p.yaml").services[0].quorum > 1


def test_a_pool_is_not_scaled_below_a_quorum():
    spec = pool_file.parse(FILE + "      quorum: 2\n  replicas: 3\n", file="p.yaml")
    fewer = scale(Intent(), spec, -1, 0.0)
    with pytest.raises(FogftError, match="cannot scale `p` to 1 replicas: the minimum is 2"):
        scale(fewer, spec, -1, 0.0)
