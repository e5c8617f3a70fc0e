"""A node's publishers and subscriptions, for serialised messages of any type.

Owns: quality of service of topics, validating bytes before they are published.
Not here: the loop (`node`), which messages to forward (`fogft.proxy`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from fogft.errors import RosError, Unreadable
from fogft.model.cdr import Shape
from fogft.model.topic import TopicSpec
from fogft.ros.entities import BURST

log = logging.getLogger(__name__)


def profile(topic: TopicSpec) -> Any:
    """Return a topic's quality of service as an rclpy QoSProfile."""
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    reliability, durability = ReliabilityPolicy, DurabilityPolicy
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=topic.depth,
        reliability=reliability.RELIABLE if topic.reliable else reliability.BEST_EFFORT,
        durability=durability.TRANSIENT_LOCAL if topic.latched else durability.VOLATILE,
    )


def mismatch(other: str, topic: TopicSpec, find: Callable[[], Any]) -> str:
    """Return which `other`, "publisher" or "subscriber", has incompatible QoS, and the remedy."""
    from rclpy.duration import Infinite
    from rclpy.qos import DurabilityPolicy, LivelinessPolicy, ReliabilityPolicy

    ours = other == "subscriber"  # we publish
    reliability = ReliabilityPolicy.RELIABLE if ours else ReliabilityPolicy.BEST_EFFORT
    durability = DurabilityPolicy.TRANSIENT_LOCAL if ours else DurabilityPolicy.VOLATILE
    try:
        found = find()
    except Exception:  # rclpy's InvalidHandle: withdrawn meanwhile
        return ""
    for one in found:
        if one.topic_type != topic.type:
            return f"a {other} of `{topic.name}` has type `{one.topic_type}`"
        if topic.reliable is not ours and one.qos_profile.reliability == reliability:
            why = "asks for reliable messages" if ours else "offers best effort"
            return f"a {other} of `{topic.name}` {why}: write `reliable: {str(ours).lower()}`"
        if topic.latched is not ours and one.qos_profile.durability == durability:
            why = "asks for latched messages" if ours else "is not latched"
            return f"a {other} of `{topic.name}` {why}: write `latched: {str(ours).lower()}`"
        within = min(one.qos_profile.deadline, one.qos_profile.liveliness_lease_duration)
        manual = one.qos_profile.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC
        if ours and (within < Infinite or manual):
            why = "asks for a deadline or liveliness, which is not offered"
            return f"a {other} of `{topic.name}` {why}: remove it from the {other}'s QoS"
    return ""


@dataclass(eq=False)
class Publisher:
    """A publisher of a node. Any thread."""

    publisher: Any
    shape: Shape
    withdraw: Callable[[Publisher], None]
    find_mismatch: Callable[[], str]

    def __post_init__(self) -> None:
        self._open = True

    def check(self, payload: bytes) -> None:
        """Raise Unreadable if bytes are not a message of this type: ROS must not get them."""
        fault = self.shape.fault(payload)
        if fault:
            raise Unreadable(f"{len(payload)} bytes are no message of its type: {fault}")

    def publish(self, payload: bytes) -> None:
        """Publish a checked message; does nothing once withdrawn. Raises RosError."""
        try:
            if self._open:
                self.publisher.publish(payload)
        except Exception as error:
            if self._open:
                raise RosError(f"a message cannot be published: {error}") from error

    def subscribers(self) -> int:
        """Count the subscriptions that discovery lists."""
        try:
            return int(self.publisher.get_subscription_count())
        except Exception:  # rclpy's InvalidHandle: withdrawn meanwhile
            return 0

    def mismatch(self) -> str:
        """Return why no subscriber receives anything; empty if one does, or if there is none."""
        return "" if self.subscribers() else self.find_mismatch()

    def close(self) -> None:
        """Withdraw the publisher; idempotent."""
        self._open = False
        self.withdraw(self)

    def destroy(self, node: Any) -> None:
        """Free all resources. Take loop only, once."""
        self._open = False
        node.destroy_publisher(self.publisher)


@dataclass(eq=False)
class Subscription:
    """A subscription of a node. Any thread."""

    subscription: Any
    on_message: Callable[[bytes], None]
    withdraw: Callable[[Subscription], None]
    mismatch: Callable[[], str]  # returns why a publisher's messages are not received

    def __post_init__(self) -> None:
        self.handle = self.subscription.handle
        self._name: str = self.subscription.topic_name
        self._open = True

    def close(self) -> None:
        """Withdraw it; idempotent. On return it is gone, unless the take loop called."""
        self._open = False
        self.withdraw(self)

    def drain(self) -> None:
        """Deliver received messages. Take loop only."""
        for _ in range(BURST):
            try:
                taken = self.handle.take_message(self.subscription.msg_type, True)
            except Exception as error:  # one message; the take loop continues
                log.warning("message_not_taken topic=%s reason=%r", self._name, str(error))
                return
            if taken is None:
                return
            try:
                if self._open:
                    self.on_message(bytes(taken[0]))
            except Exception:
                log.exception("%s: a message was lost", self._name)

    def destroy(self, node: Any) -> None:
        """Free all resources. Take loop only, once, when no wait set holds the handle."""
        self._open = False
        node.destroy_subscription(self.subscription)
