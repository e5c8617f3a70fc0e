"""Topics and actions proxied between the robot and its replicas, as values. Pure."""

from dataclasses import dataclass
from enum import Enum

from fogft.model.keys import DAY_S, Flag, Number, OneOf, Text, Whole, key, only
from fogft.model.ros_names import is_action_type, is_message_type, service_name

PREFIX = "topic "  # of a topic's name on the wire, to tell it from a service
DEPTH_LIMIT = 1000


class Origin(str, Enum):
    """Which side publishes a topic."""

    ROBOT = "robot"  # each message goes to every replica
    REPLICAS = "replicas"  # what they publish comes to the robot, duplicates dropped


class Select(str, Enum):
    """Which replicas' messages the robot gets."""

    LEADER = "leader"  # those of one replica at a time
    STAMP = "stamp"  # the first with each header stamp
    ALL = "all"  # every one
    GOAL = "goal"  # an action's feedback: those of one replica at a time, goal by goal
    STATUS = "status"  # an action's status: one list of all replicas' goals


@dataclass(frozen=True)
class TopicSpec:
    """One proxied topic."""

    name: str = key(
        service_name("write a name such as `/topic`", "the name of a topic"),
        "Name of the topic, on the robot and on the replicas.",
    )
    type: str = key(
        Text(
            "a message type",
            "write `package/msg/Name`, such as `type: sensor_msgs/msg/Image`",
            only(is_message_type),
            has_parts=True,
        ),
        "Its type; it must be installed on the robot.",
    )
    origin: Origin = key(
        OneOf(Origin),
        "Who publishes it. `robot`: each message goes to every replica. `replicas`: what they "
        "publish comes to the robot, duplicates dropped.",
        name="from",
    )
    select: Select = key(
        OneOf(Select, hidden=(Select.GOAL, Select.STATUS)),
        "With `from: replicas`, which messages the robot gets: those of one replica at a time "
        "(`leader`), the first with each `header.stamp` (`stamp`), or every one (`all`).",
        default=Select.LEADER,
    )
    depth: int = key(
        Whole(1, DEPTH_LIMIT, "messages"),
        "Messages kept for slow subscribers and, if latched, for late ones: of all publishers "
        "together, so `/tf_static` of many nodes needs more.",
        default=10,
    )
    reliable: bool = key(
        Flag(),
        "Reliable at both ends; use `false` if a publisher offers only best effort.",
        default=True,
    )
    latched: bool = key(
        Flag(),
        "Transient local at both ends: nodes and replicas that join later get the last `depth` "
        "messages.",
        default=False,
    )

    @property
    def key_name(self) -> str:
        """The topic's name on the link, and in a replica's list of ready services."""
        return PREFIX + self.name


@dataclass(frozen=True)
class ActionSpec:
    """One proxied action: three services and two topics."""

    name: str = key(
        service_name("write a name such as `/action`", "the name of an action"),
        "Name of the action, on the robot and on the replicas.",
    )
    type: str = key(
        Text(
            "an action type",
            "write `package/action/Name`, such as `type: nav2_msgs/action/Spin`",
            only(is_action_type),
        ),
        "Its type; it must be installed on the robot.",
    )
    timeout_s: float = key(
        Number(DAY_S, "seconds"),
        "Time allowed to accept or reject a goal, or to answer a cancellation.",
        default=10.0,
    )
    result_timeout_s: float = key(
        Number(30 * DAY_S, "seconds"),
        "Time allowed for the result of a goal; after that there is no answer.",
        default=3600.0,
    )
