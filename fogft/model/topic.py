"""A topic that passes between the robot and its replicas, as values. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import Enum
from typing import Any

PREFIX = "topic "  # of a topic's name on the wire, where it stands beside services
DEPTH_LIMIT = 1000


class Origin(str, Enum):
    """Who publishes."""

    ROBOT = "robot"  # each message goes to every replica
    REPLICAS = "replicas"  # what they publish comes to the robot, duplicates dropped


class Select(str, Enum):
    """Which of several replicas' messages the robot gets."""

    LEADER = "leader"  # those of one replica at a time
    STAMP = "stamp"  # the first with each header stamp
    ALL = "all"  # every one
    GOAL = "goal"  # an action's feedback: those of one replica at a time, goal by goal
    STATUS = "status"  # an action's status: one list of all replicas' goals


@dataclass(frozen=True)
class Quality:
    """Quality of service of a topic: how many messages are kept, and for whom."""

    depth: int = 10
    reliable: bool = True
    latched: bool = False


@dataclass(frozen=True)
class TopicSpec:
    """One proxied topic.

    Attributes:
        depth: Messages that are kept for who is slow, or comes later where it is latched.
        reliable: Quality of service at both ends; best effort where false.
        latched: Whether who comes later gets the last `depth` messages (transient local).
    """

    name: str
    type: str
    origin: Origin
    select: Select = Select.LEADER
    depth: int = 10
    reliable: bool = True
    latched: bool = False

    @property
    def key_name(self) -> str:
        """Its name on the wire, and in what a replica says is ready."""
        return PREFIX + self.name

    @property
    def quality(self) -> Quality:
        """The quality of service that both ends ask ROS for."""
        return Quality(self.depth, self.reliable, self.latched)

    def to_plain(self) -> dict[str, Any]:
        """Return what a configuration file says of it; defaults are left out."""
        return {
            field.name: getattr(value, "value", value)
            for field in fields(TopicSpec)
            if (value := getattr(self, field.name)) != field.default
        }

    @classmethod
    def from_plain(cls, raw: Mapping[str, Any]) -> TopicSpec:
        """Return the topic of a configuration file.

        Raises:
            KeyError: Name, type or origin are missing.
            ValueError: A value is out of range or unknown.
            TypeError: A value is of the wrong type.
        """
        depth = int(raw.get("depth") or cls.depth)
        if not 1 <= depth <= DEPTH_LIMIT:
            raise ValueError(f"a depth of {depth}")
        return cls(
            name=str(raw["name"]),
            type=str(raw["type"]),
            origin=Origin(raw["origin"]),
            select=Select(raw.get("select") or cls.select),
            depth=depth,
            reliable=bool(raw.get("reliable", True)),
            latched=bool(raw.get("latched", False)),
        )
