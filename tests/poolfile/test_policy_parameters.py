"""Policies as parameters: what is shown can be set back, and a pool file's rules hold."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.errors import RosError
from fogft.model.choices import FallbackSpec, TrafficSpec
from fogft.model.spec import Advertise, HedgingMode, OnTimeout, Part, ServiceSpec
from fogft.model.state import StateService, StateSpec
from fogft.poolfile.policy_parameters import KEYS, Policies, changed, prefix, shown

PLAN = ServiceSpec("/arm/plan", "nav_msgs/srv/GetPlan")
STATE = StateSpec(
    StateService("/s/get", "nav_msgs/srv/GetMap", "map.data"),
    StateService("/s/set", "nav_msgs/srv/SetMap", "map.data"),
)


@st.composite
def services(draw):
    hedging = draw(st.sampled_from(HedgingMode))
    on_timeout = draw(st.sampled_from(OnTimeout))
    falls_back = on_timeout is OnTimeout.FALLBACK
    return ServiceSpec(
        "/arm/plan",
        "nav_msgs/srv/GetPlan",
        timeout_s=draw(st.floats(1.0, 100.0)),
        hedging=hedging,
        on_timeout=on_timeout,
        fallback=FallbackSpec("/on_board", after_s=0.5) if falls_back else None,
        ok_field=draw(st.sampled_from(("", "success"))),
        trace=draw(st.booleans()),
        advertise=draw(st.sampled_from((None, *Advertise))),
        traffic=TrafficSpec(requests_per_s=draw(st.sampled_from((0.0, 5.0)))),
    )


values = st.dictionaries(
    st.sampled_from(KEYS),
    st.one_of(
        st.booleans(),
        st.floats(-1, 200),
        st.sampled_from(["all", "auto", "failover", "silent", "empty", "fallback", "", "ok"]),
        st.sampled_from([a.value for a in Advertise]),
    ),
)


@given(service=services())
def test_what_is_shown_can_be_set_back_and_changes_nothing(service):
    assert changed(service, shown(service)) == service


@given(service=services(), news=values)
def test_what_holds_is_shown_and_nothing_else_has_changed(service, news):
    """Of the policy; a fallback without its mode is gone with that."""
    before = shown(service)
    try:
        after = changed(service, news)
    except ValueError:
        return
    now = shown(after)
    assert {key: now[key] for key in news} == news
    # Unless told, when a service is advertised follows from what happens at its deadline.
    kept = set(KEYS) - {"advertise"} if service.advertise is None else set(KEYS)
    assert {k: now[k] for k in kept if k not in news} == {
        k: before[k] for k in kept if k not in news
    }
    assert (after.name, after.type, after.traffic) == (
        service.name, service.type, service.traffic,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("news", "why"),
    [
        ({"timeout_s": 0.0}, "timeout_s: must be above 0"),
        ({"timeout_s": "soon"}, "timeout_s: must be a number"),
        ({"hedging": "some"}, "hedging: must be `auto` or"),
        ({"on_timeout": "fallback"}, "fallback_service: is missing"),
        ({"trace": "yes"}, "trace: must be true or false"),
        ({"advertise": "never"}, "advertise: must be"),
        ({"ok_field": "Not A Field"}, "ok_field: `Not A Field` is not"),
        ({"quorum": 2}, "no parameter `quorum`"),
    ],
)
def test_what_a_pool_file_may_not_say_is_refused_with_the_reason(news, why):
    with pytest.raises(ValueError, match="^" + why if why[0] != "n" else why):
        changed(PLAN, news)


def test_a_policy_is_not_offered_where_the_service_cannot_have_it():
    assert set(shown(PLAN)) == set(KEYS)
    assert set(shown(replace(PLAN, quorum=2))) == set(KEYS) - {"hedging", "ok_field"}
    stateful = shown(replace(PLAN, state=STATE))
    assert set(stateful) == {"timeout_s", "on_timeout", "advertise"}


def test_a_service_has_its_parameters_under_its_name():
    assert prefix("/arm/plan") == "arm.plan"
    policies = Policies()
    policies.follow([PLAN])
    assert policies.parameters()["arm.plan.hedging"] == "auto"


def test_a_value_holds_until_the_file_changes_that_key():
    policies = Policies()
    policies.follow([PLAN])
    policies.set({"arm.plan.timeout_s": 3.0, "arm.plan.hedging": "failover"})
    [now] = policies.services()
    assert (now.timeout_s, now.hedging) == (3.0, HedgingMode.FAILOVER)
    policies.follow([replace(PLAN, timeout_s=7.0)])
    [now] = policies.services()
    assert (now.timeout_s, now.hedging) == (7.0, HedgingMode.FAILOVER)
    policies.follow([])
    policies.follow([PLAN])
    assert policies.services() == (PLAN,)


def test_a_refused_set_changes_nothing_even_in_part():
    policies = Policies(lambda kind, field: RosError(f"{kind} has no boolean field {field}"))
    policies.follow([PLAN])
    for news in ({"timeout_s": 3.0, "hedging": "some"}, {"timeout_s": 3.0, "ok_field": "success"}):
        with pytest.raises(ValueError):
            policies.set({f"arm.plan.{key}": value for key, value in news.items()})
        assert policies.services() == (PLAN,)
    with pytest.raises(ValueError, match=r"no parameter `leg\.plan\.hedging`"):
        policies.set({"leg.plan.hedging": "all"})


def test_the_fallback_comes_back_with_its_mode():
    """It is the file's; a parameter only says whether it is used."""
    spec = replace(PLAN, on_timeout=OnTimeout.FALLBACK, fallback=FallbackSpec("/on_board"))
    policies = Policies()
    policies.follow([spec])
    policies.set({"arm.plan.on_timeout": "silent"})
    assert policies.services()[0].fallback is None
    policies.set({"arm.plan.on_timeout": "fallback"})
    assert policies.services() == (spec,)


@pytest.mark.parametrize("value", [None, [1.0, 2.0], b"x", True, "x", float("nan"), -1, 10**30])
def test_a_value_of_another_type_is_refused_and_changes_nothing(value):
    """ROS lets anybody on the robot set any type, or delete a parameter."""
    goal = ServiceSpec("/move/_action/send_goal", "a/action/M_SendGoal", 5.0, part=Part.GOAL)
    policies = Policies()
    policies.follow([goal, PLAN])
    before = policies.parameters()
    for name in ("move._action.send_goal.timeout_s", "arm.plan.timeout_s"):
        with pytest.raises((ValueError, TypeError)):
            policies.set({name: value})
    assert policies.parameters() == before
