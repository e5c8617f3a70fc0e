"""`topics` and `actions` in a pool file."""

from __future__ import annotations

import pytest

from fogft.errors import SpecError
from fogft.model.plain import from_plain, to_plain
from fogft.model.spec import Part, ServiceSpec
from fogft.model.topic import Origin, Select, TopicSpec
from fogft.poolfile import file
from fogft.poolfile.pool import Checks

FILE = """\
name: p
run: serve
fogft:
  %s: %s
"""


def parse(key: str, value: str, **more):
    return file.parse(FILE % (key, value), file="p.yaml", checks=Checks(**more))


def test_a_topic_has_its_direction_and_its_quality():
    one = "{name: a, type: p/msg/T, from: robot, depth: 1, latched: true}"
    two = "{name: /b, type: p/msg/T, from: replicas, select: stamp, reliable: false}"
    spec = parse("topics", f"[{one}, {two}]")
    assert spec.topics == (
        TopicSpec("/a", "p/msg/T", Origin.ROBOT, depth=1, latched=True),
        TopicSpec("/b", "p/msg/T", Origin.REPLICAS, Select.STAMP, reliable=False),
    )


def test_an_action_is_three_services_and_two_topics():
    spec = parse("actions", "[{name: /a, type: p/action/T, timeout_s: 5, result_timeout_s: 60}]")
    assert [(s.name, s.type, s.timeout_s, s.part) for s in spec.services] == [
        ("/a/_action/send_goal", "p/action/T_SendGoal", 5.0, Part.GOAL),
        ("/a/_action/cancel_goal", "action_msgs/srv/CancelGoal", 5.0, Part.CANCEL),
        ("/a/_action/get_result", "p/action/T_GetResult", 60.0, Part.RESULT),
    ]
    assert [(t.name, t.select, t.latched) for t in spec.topics] == [
        ("/a/_action/feedback", Select.GOAL, False),
        ("/a/_action/status", Select.STATUS, True),
    ]
    assert (
        tuple(from_plain(ServiceSpec, to_plain(service)) for service in spec.services)
        == spec.services
    )


def test_a_topic_more_replaces_the_replicas():
    """They must publish and subscribe to it."""
    one = parse("topics", "[{name: a, type: p/msg/T, from: robot}]")
    two = parse("topics", "[{name: a, type: p/msg/T, from: replicas}]")
    assert one.replica_hash != two.replica_hash


def test_types_are_looked_up_by_name():
    asked = []
    parse("topics", "[{name: a, type: p/msg/T, from: robot}]", types=asked.append)
    parse("actions", "[{name: a, type: p/action/T}]", types=asked.append)
    assert asked == ["p/msg/T", "p/action/T_SendGoal"]
    lacking = SpecError("there is none", "x")
    with pytest.raises(SpecError, match="type: there is none") as found:
        parse("actions", "[{name: a, type: p/action/T}]", types=lambda _: lacking)
    assert found.value.hint == "x"


WRONG = {
    "no list": ("topics", "{name: a}", "must be a list"),
    "no type": ("topics", "[{name: a, from: robot}]", "type: is missing"),
    "a service's type": ("topics", "[{name: a, type: p/srv/T, from: robot}]", "not a message type"),
    "nobody": ("topics", "[{name: a, type: p/msg/T}]", "from: is missing"),
    "somebody else": ("topics", "[{name: a, type: p/msg/T, from: cloud}]", "must be `robot`"),
    "select of the robot's": (
        "topics", "[{name: a, type: p/msg/T, from: robot, select: all}]", "no effect here"),
    "unknown select": (
        "topics", "[{name: a, type: p/msg/T, from: replicas, select: goal}]", "must be `leader`"),
    "depth": ("topics", "[{name: a, type: p/msg/T, from: robot, depth: 0}]", "from 1 to 1000"),
    "twice": ("topics", "[{name: a, type: p/msg/T, from: robot}, "
              "{name: /a, type: p/msg/T, from: robot}]", "twice"),
    "bad name": ("topics", "[{name: 1a, type: p/msg/T, from: robot}]", "not the name of a topic"),
    "action type": ("actions", "[{name: a, type: p/msg/T}]", "not an action type"),
    "action twice": ("actions", "[{name: a, type: p/action/T}, {name: a, type: p/action/T}]",
                     "twice"),
    "unknown key": ("actions", "[{name: a, type: p/action/T, hedging: all}]", "unknown key"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_mistakes_are_told_with_line_and_remedy(case):
    key, value, words = WRONG[case]
    with pytest.raises(SpecError, match=words) as found:
        parse(key, value)
    assert found.value.message.startswith(f"p.yaml:4: fogft.{key}")
    assert found.value.hint


def test_they_do_not_go_with_gateways_yet():
    more = "\n  rendezvous: [m:1]\n  topology: {gateways: [{name: a, endpoint: h:1}]}"
    with pytest.raises(SpecError, match="cannot be combined with `topology`"):
        parse("topics", "[{name: a, type: p/msg/T, from: robot}]" + more)
