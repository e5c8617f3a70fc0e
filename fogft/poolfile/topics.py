"""Judge `topics` and `actions` of a pool file.

An action is three services and two topics; it is proxied as those.
"""

from __future__ import annotations

from enum import Enum

from fogft.model import ros_names
from fogft.model.spec import OnTimeout, Part, ServiceSpec
from fogft.model.topic import DEPTH_LIMIT, Origin, Select, TopicSpec
from fogft.poolfile.keys import ACTION_KEYS, CONCURRENCY_LIMIT, DAY_S, TOPIC_KEYS
from fogft.poolfile.tree import Section, shown

_TOPICS_HINT = (
    "write a list, such as `topics: [{name: /map, type: nav_msgs/msg/OccupancyGrid, from: robot}]`"
)
_ACTIONS_HINT = "write a list, such as `actions: [{name: /move, type: my_msgs/action/Move}]`"
RESULT_S = 3600.0


class _Select(str, Enum):
    """What may be written."""

    LEADER = Select.LEADER.value
    STAMP = Select.STAMP.value
    ALL = Select.ALL.value


def read_topics(ours: Section) -> tuple[TopicSpec, ...]:
    """Return the topics that pass.

    Raises:
        SpecError: The first mistake.
    """
    if "topics" not in ours.children:
        return ()
    found: dict[str, TopicSpec] = {}
    for section in ours.sections("topics", _TOPICS_HINT):
        section.only(TOPIC_KEYS)
        topic = _topic(section)
        if topic.name in found:
            raise section.error("name", f"`{topic.name}` stands here twice", "give it one entry")
        found[topic.name] = topic
    return tuple(found.values())


def _topic(section: Section) -> TopicSpec:
    example = "write `package/msg/Name`, such as `type: sensor_msgs/msg/Image`"
    type = section.text("type", example)
    if not ros_names.is_type(type, "msg"):
        raise section.error("type", f"{shown(type)} is not a message type", example)
    if "from" not in section.children:
        hint = "write `from: robot` or `from: replicas`: who publishes it"
        raise section.error("from", "is missing", hint)
    origin = section.choice("from", Origin.ROBOT)
    if origin is Origin.ROBOT and "select" in section.children:
        what = "has no meaning here: what the robot publishes comes from one place"
        raise section.error("select", what, "remove it")
    return TopicSpec(
        name=_name(section, "topic"),
        type=type,
        origin=origin,
        select=Select(section.choice("select", _Select.LEADER).value),
        depth=section.whole("depth", TopicSpec.depth, 1, DEPTH_LIMIT),
        reliable=section.flag("reliable", TopicSpec.reliable),
        latched=section.flag("latched", TopicSpec.latched),
    )


def read_actions(ours: Section) -> tuple[tuple[ServiceSpec, ...], tuple[TopicSpec, ...]]:
    """Return the services and the topics of the actions that are proxied.

    Raises:
        SpecError: The first mistake.
    """
    if "actions" not in ours.children:
        return (), ()
    services: list[ServiceSpec] = []
    topics: list[TopicSpec] = []
    for section in ours.sections("actions", _ACTIONS_HINT):
        section.only(ACTION_KEYS)
        name = _name(section, "action")
        if any(one.name == f"{name}/_action/send_goal" for one in services):
            raise section.error("name", f"`{name}` stands here twice", "give it one entry")
        example = "write `package/action/Name`, such as `type: nav2_msgs/action/Spin`"
        type = section.text("type", example)
        if not ros_names.is_type(type, "action"):
            raise section.error("type", f"{shown(type)} is not an action type", example)
        timeout_s = section.number("timeout_s", DAY_S, "seconds", ServiceSpec.timeout_s)
        result_s = section.number("result_timeout_s", 30 * DAY_S, "seconds", RESULT_S)
        services += action_services(name, type, timeout_s, result_s)
        topics += action_topics(name, type)
    return tuple(services), tuple(topics)


def action_services(
    name: str, type: str, timeout_s: float, result_timeout_s: float
) -> tuple[ServiceSpec, ...]:
    """Return the three services of an action."""

    def one(end: str, kind: str, part: Part, seconds: float, concurrency: int) -> ServiceSpec:
        return ServiceSpec(
            f"{name}/_action/{end}",
            kind,
            timeout_s=seconds,
            on_timeout=OnTimeout.SILENT,
            concurrency=concurrency,
            part=part,
        )

    return (
        one("send_goal", f"{type}_SendGoal", Part.GOAL, timeout_s, 0),
        one("cancel_goal", "action_msgs/srv/CancelGoal", Part.CANCEL, timeout_s, 0),
        # It is answered when its goal ends: many wait there without being at work.
        one("get_result", f"{type}_GetResult", Part.RESULT, result_timeout_s, CONCURRENCY_LIMIT),
    )


def action_topics(name: str, type: str) -> tuple[TopicSpec, ...]:
    """Return the two topics of an action."""
    feedback, status = f"{name}/_action/feedback", f"{name}/_action/status"
    of_status = "action_msgs/msg/GoalStatusArray"
    return (
        TopicSpec(feedback, f"{type}_FeedbackMessage", Origin.REPLICAS, Select.GOAL),
        TopicSpec(status, of_status, Origin.REPLICAS, Select.STATUS, depth=1, latched=True),
    )


def _name(section: Section, what: str) -> str:
    written = section.text("name", f"write the {what}'s name, such as `name: /{what}`")
    try:
        return ros_names.absolute_service_name(written)
    except ValueError as error:
        wrong = f"{shown(written)} is not the name of a {what}: {error}"
        raise section.error("name", wrong, f"write a name such as `/{what}`") from None
