"""How the proxies speak ROS, on the robot and on the replicas. Pure values.

Owns: the choice. Not here: what carries it out (`fogft.proxy.middleware`).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from fogft.model.keys import OneOf, key


class Speaks(str, Enum):
    """How a proxy speaks ROS."""

    RCLPY = "rclpy"  # by the ROS 2 that is installed where it runs, whatever its middleware
    ZENOH = "zenoh"  # as the nodes of `rmw_zenoh` do, with no ROS installed


@dataclass(frozen=True)
class Middleware:
    """How each side's proxy speaks ROS."""

    robot: Speaks = key(
        OneOf(Speaks),
        "How every robot's client proxy talks to the robot's nodes.",
        default=Speaks.RCLPY,
    )
    replica: Speaks = key(
        OneOf(Speaks),
        "How every replica's server proxy talks to what `run` starts; a change replaces replicas.",
        default=Speaks.RCLPY,
    )
