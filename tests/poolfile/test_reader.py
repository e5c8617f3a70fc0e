"""What a pool file may hold, judged on trees made by hand: no YAML here."""

from __future__ import annotations

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.errors import SpecError
from fogft.model import ros_names
from fogft.model.choices import Compression, Freshness, Middleware, Speaks
from fogft.model.names import POOL_NAME_PATTERN
from fogft.model.plain import to_plain
from fogft.model.spec import HealthSpec, HedgingMode, OnTimeout, PoolSpec, ServiceSpec
from fogft.poolfile.pool import Checks, pool_spec
from fogft.poolfile.task import TASK_KEYS
from fogft.poolfile.tree import Node, plain, shown

LATER_KEYS = ["autoscale"]


def tree(value, line=1):
    """Make a tree; every value stands in line 1."""
    if isinstance(value, dict):
        value = {key: tree(child) for key, child in value.items()}
    elif isinstance(value, list):
        value = tuple(tree(child) for child in value)
    return Node(value, line, line)


def read(document, **checks):
    return pool_spec(tree(document), "pool.yaml", Checks(**checks))


def read_or_error(document):
    try:
        return read(document)
    except SpecError as error:
        return error


def document(**fogft):
    return {
        "run": "exec python3 x.py",
        "fogft": {"services": [{"name": "/a", "type": "std_srvs/srv/SetBool"}], **fogft},
    }


def test_defaults_are_the_specs_own():
    """What the file leaves out has the value that the dataclasses document."""
    assert read(document()) == PoolSpec(
        name="pool",
        services=(ServiceSpec("/a", "std_srvs/srv/SetBool"),),
        task={"run": "exec python3 x.py"},
    )


services = st.lists(
    st.builds(
        ServiceSpec,
        name=st.from_regex(r"(/[a-z_][a-z0-9_]{0,5}){1,3}", fullmatch=True),
        type=st.from_regex(r"[a-z]{1,5}/srv/[A-Z][a-z0-9]{0,5}", fullmatch=True),
        timeout_s=st.floats(0.001, 86_400),
        on_timeout=st.sampled_from([OnTimeout.SILENT, OnTimeout.EMPTY]),
        ok_field=st.sampled_from(["", "success", "ok_2"]),
        hedging=st.sampled_from(HedgingMode),
        concurrency=st.integers(0, 512),
        freshness=st.sampled_from(Freshness),
        compression=st.sampled_from(Compression),
    ),
    min_size=1,
    max_size=4,
    unique_by=lambda service: service.name,
)
specs = st.builds(
    PoolSpec,
    name=st.from_regex(POOL_NAME_PATTERN, fullmatch=True),
    services=services.map(tuple),
    replicas=st.integers(1, 16),
    max_surge=st.integers(0, 4),
    max_usd_per_hour=st.none() | st.floats(0.01, 1000),
    max_hours=st.none() | st.floats(0.01, 8000),
    health=st.builds(
        HealthSpec,
        suspect_after_s=st.floats(0.1, 3600),
        replace_after_s=st.floats(0.1, 86_400),
        start_limit_s=st.floats(0.1, 86_400),
    ),
    unmanaged_max_hours=st.floats(0.1, 8000),
)


@given(spec=specs, task=st.dictionaries(st.sampled_from(["setup", "event_callback"]), st.just("x")))
def test_what_was_written_is_what_is_read(spec, task):
    """Every spec can be written as a file, and reads back as itself; the task is untouched."""
    ours = to_plain(spec, omit_defaults=True)
    ours.pop("name", None)
    for service in ours["services"]:
        if "compression" in service:
            service["advanced"] = {"compression": service.pop("compression")}
    whole_task = {"name": spec.name, "run": "x", **task}
    read_back = read({**whole_task, "fogft": ours})
    assert read_back.task == whole_task
    assert read_back == PoolSpec(**{**vars(spec), "task": whole_task})


scalars = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
names = st.sampled_from([*TASK_KEYS, *LATER_KEYS, "fogft", "services", "type", "health", "service"])
anything = st.recursive(
    scalars,
    lambda child: st.lists(child, max_size=3) | st.dictionaries(names | st.text(max_size=4), child),
    max_leaves=12,
)


@given(top=anything, fogft=anything, service=anything)
def test_any_tree_is_read_or_is_one_spec_error(top, fogft, service):
    """Whatever stands in a file, the user gets one line that begins with file and line."""
    documents = [top, {"run": "x", "fogft": fogft}, document(services=[service])]
    if isinstance(top, dict):
        documents.append({**document(), **top})
    if isinstance(fogft, dict):
        documents.append(document(**fogft))
    for each in documents:
        spec = read_or_error(each)
        if isinstance(spec, PoolSpec):
            assert len(spec.replica_hash) == 16
        else:
            assert re.match(r"pool\.yaml:1: \S.*: \S", spec.message)
            assert "\n" not in spec.message + spec.hint
            assert spec.hint


@pytest.mark.parametrize("key", ["timeout_s", "suspect_after_s", "unmanaged_max_hours"])
@pytest.mark.parametrize("value", [0, -1, -0.0, math.nan, math.inf, -math.inf, 1e300, True, "1"])
def test_impossible_durations_are_refused(key, value):
    """No duration is zero, negative, infinite, not a number, a truth value or a text."""
    if key == "timeout_s":
        written = document(services=[{"name": "a", "type": "a/srv/B", key: value}])
    elif key == "suspect_after_s":
        written = document(health={key: value})
    else:
        written = document(**{key: value})
    with pytest.raises(SpecError, match=rf"^pool\.yaml:1: fogft\.\S*{key}: must be"):
        read(written)


@pytest.mark.parametrize("key", sorted(LATER_KEYS))
def test_a_key_of_the_future_is_refused_not_ignored(key):
    """What is designed and not built must not look as if it worked."""
    for written in (document(**{key: 1}), {**document(), key: 1}):
        with pytest.raises(SpecError, match=rf"^pool\.yaml:1: (fogft\.)?{key}: is not supported"):
            read(written)


def test_types_are_checked_once_each_and_last():
    """A type is looked up only in a file that has no other mistake."""
    asked = []

    def check(type_name):
        asked.append(type_name)

    services = [{"name": "a", "type": "a/srv/A"}, {"name": "b", "type": "b/srv/B"}]
    read(document(services=services), types=check)
    assert asked == ["a/srv/A", "b/srv/B"]
    asked.clear()
    with pytest.raises(SpecError, match="is listed twice"):
        read(document(services=[*services, services[0]]), types=check)
    assert asked == []


@given(name=st.text(max_size=12) | st.from_regex(r"/?[a-z0-9_/~{}]*", fullmatch=True))
def test_absolute_names_are_absolute_and_stay(name):
    """Making a name absolute gives a name that is accepted as it is."""
    try:
        absolute = ros_names.absolute_service_name(name)
    except ValueError:
        return
    assert absolute in (name, "/" + name)
    assert absolute.startswith("/")
    assert ros_names.absolute_service_name(absolute) == absolute


@pytest.mark.parametrize("name", ["a/srv/B", "nav_msgs/srv/GetPlan", "a1_b/srv/A9"])
def test_service_types(name):
    assert ros_names.is_service_type(name)


@pytest.mark.parametrize(
    "name",
    [
        "",
        "a/srv",
        "a/msg/B",
        "A/srv/B",
        "a/srv/b",
        "a_/srv/B",
        "a__b/srv/B",
        "a/srv/B/C",
        "a/srv/B ",
    ],
)
def test_what_is_no_service_type(name):
    assert not ros_names.is_service_type(name)


@pytest.mark.parametrize(
    "written",
    ["nav_msgs/GetPlan", "nav_msgs.srv.GetPlan", "nav_msgs::srv::GetPlan", "nav_msgs/srvs/GetPlan"],
)
def test_other_spellings_of_a_type_are_recognised(written):
    assert ros_names.suggested_service_type(written) == "nav_msgs/srv/GetPlan"


@given(value=anything)
def test_plain_undoes_the_tree(value):
    """A tree holds exactly the values it was made of."""
    assert repr(plain(tree(value))) == repr(value)


@given(text=st.text())
def test_shown_text_is_one_printable_line(text):
    """Nothing that a file holds can break a message or reach the terminal as a command."""
    assert shown(text).isprintable()


@pytest.mark.parametrize(
    ("rmw", "robot", "replica"),
    [
        (None, "rclpy", "rclpy"),
        ("zenoh", "zenoh", "zenoh"),
        ({"robot": "zenoh"}, "zenoh", "rclpy"),
        ({"replica": "zenoh", "robot": "rclpy"}, "rclpy", "zenoh"),
    ],
)
def test_rmw_is_one_word_or_one_for_each_side(rmw, robot, replica):
    """Client proxies and server proxies may speak ROS differently; only replicas are replaced."""
    spec = read(document(**({} if rmw is None else {"rmw": rmw})))
    assert spec.rmw == Middleware(Speaks(robot), Speaks(replica))
    same = read(document()).replica_hash == spec.replica_hash
    assert same == (replica == "rclpy")


@pytest.mark.parametrize("rmw", ["dds", 3, ["zenoh"], {"robots": "zenoh"}, {"robot": "rmw_zenoh"}])
def test_rmw_is_one_of_the_ways_there_are(rmw):
    with pytest.raises(SpecError, match=r"pool.yaml:1: fogft\.rmw"):
        read(document(rmw=rmw))


def test_a_robot_over_zenoh_needs_no_type_but_where_a_policy_looks_into_responses():
    """What passes through untouched need not be known; what is made or read must be."""
    refuse = {"types": lambda name: SpecError(f"there is no `{name}`")}
    assert read(document(rmw="zenoh"), **refuse).rmw.robot is Speaks.ZENOH
    for rmw in ("rclpy", {"replica": "zenoh"}):
        with pytest.raises(SpecError, match="there is no"):
            read(document(rmw=rmw), **refuse)
    for policy in ({"on_timeout": "empty"}, {"ok_field": "success"}, {"quorum": 2}):
        asked = document(rmw="zenoh")
        asked["fogft"]["services"][0].update(policy)
        with pytest.raises(SpecError, match="there is no"):
            read(asked, **refuse)


def test_topics_and_actions_do_not_pass_over_zenoh():
    topic = {"name": "/t", "type": "std_msgs/msg/Header", "from": "robot"}
    with pytest.raises(SpecError, match=r"fogft\.topics: cannot be combined with `rmw: zenoh`"):
        read(document(rmw={"replica": "zenoh"}, topics=[topic]))
    with pytest.raises(SpecError, match=r"fogft\.actions: cannot be combined with `rmw: zenoh`"):
        read(document(rmw="zenoh", actions=[{"name": "/a2", "type": "a/action/B"}]))
