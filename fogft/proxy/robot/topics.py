"""Topics on the robot: sends its messages to every replica, publishes the replicas' messages here.

Owns: the robot's subscriptions and publishers, each replica's outbox, and pulls.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from fogft.counters import worth_logging
from fogft.errors import FrameError, RosError, Unreadable
from fogft.link.port import Answer, Link
from fogft.model.names import REQUEST_ID_BYTES
from fogft.model.refusal import Refusal
from fogft.model.replica import short
from fogft.model.topic import Origin, Select, TopicSpec
from fogft.proxy.robot.dispatcher import MALFORMED_LIMIT
from fogft.topics import frames
from fogft.topics.queues import Outbox, Ring
from fogft.topics.select import Selection

if TYPE_CHECKING:
    from fogft.ros.node import SerialisedNode
    from fogft.ros.topic_ends import Publisher, Subscription

log = logging.getLogger(__name__)

_MESSAGE_S = 10.0  # a message not confirmed within this time is sent again
_PULL_S = 10.0
_AGAIN_S = 0.2  # after a refusal
_AT_ONCE_S = 0.1  # a replica that answers a pull sooner, without messages, did not hold it
_LOOK_EVERY_S = 2.0  # check whether publishers are heard, and compute the rate
_UNCONFIRMED_LIMIT = 4096
_STATUS_BYTES = 128 << 10  # 4000 goals; limited since each status makes us merge all replicas'


# Merges the last messages of several replicas into one; None if there is nothing to publish.
Merge = Callable[[Mapping[int, bytes]], bytes | None]


class _Way:
    """The state of one topic towards one replica."""

    def __init__(self, topic: TopicSpec) -> None:
        self.outbox = Outbox(topic.depth)
        self.session, self.after = frames.NO_SESSION, 0
        self.rest_until = self.pulled_at = 0.0
        self.out: dict[bytes, int] = {}  # request id -> a message's number; 0 for a pull
        self.offer: Callable[..., bool] | None = None  # of the connection that `out` is on


class RobotTopic:
    """One topic on the robot."""

    def __init__(
        self, topic: TopicSpec, clock: Callable[[], float], wake: Callable[[], None], merge: Merge
    ) -> None:
        self.topic = topic
        self._clock = clock
        self._wake = wake
        self._merge = merge
        self._lock = threading.RLock()
        self._session = os.urandom(frames.SESSION_BYTES)
        # Numbers the messages and, if latched, keeps them for replicas that come later.
        self._kept = Ring(topic.depth if topic.latched else 0, latched=True)
        self._ways: dict[int, _Way] = {}
        self._links: dict[int, Link] = {}
        self._selection = Selection(topic.select)
        self._said: dict[int, bytes] = {}
        self._told: bytes | None = None
        self._publisher: Publisher | None = None
        self._subscription: Subscription | None = None
        self._looked_at = clock()
        self.trouble = ""
        self._unconfirmed: dict[int, None] = {}
        self.malformed: Counter[int] = Counter()
        self._rate_hz, self._counted = 0.0, (clock(), 0)
        self.count = dict.fromkeys(("messages", "passed", "dropped", "refused"), 0)

    def open(self, node: SerialisedNode) -> None:
        """Create the publisher or subscription. Raises RosError."""
        topic = self.topic
        if topic.origin is Origin.ROBOT:
            self._subscription = node.subscribe(topic, self.heard)
        else:
            self._publisher = node.publisher(topic)

    def close(self) -> None:
        """Close the publisher or subscription."""
        for end in (self._publisher, self._subscription):
            if end is not None:
                end.close()

    def report(self) -> dict[str, Any]:
        """Return counters, the rate and, if messages do not get through, the reason."""
        trouble = {"trouble": self.trouble} if self.trouble else {}
        return {**self.count, "rate_hz": round(self._rate_hz, 2), **trouble}

    # -- the robot's own messages ---------------------------------------------------------

    def heard(self, message: bytes) -> None:
        """Take a message from ROS for every replica."""
        with self._lock:
            self._kept.put(message)
            number = self._kept.last
            self.count["messages"] += 1
            self.count["dropped"] += not (self._ways or self.topic.latched)
            self._unconfirmed[number] = None
            if len(self._unconfirmed) > _UNCONFIRMED_LIMIT:
                del self._unconfirmed[next(iter(self._unconfirmed))]
            for way in self._ways.values():
                self.count["dropped"] += way.outbox.put(number, message)
            self._send()

    def route(self, links: Mapping[int, Link], members: Iterable[int]) -> None:
        """Set the links to use now, and all replicas."""
        with self._lock:
            known = set(members)
            for key in self._ways.keys() - known:
                del self._ways[key]
                self._said.pop(key, None)
            for key in known - self._ways.keys():
                way = self._ways[key] = _Way(self.topic)
                for number, message in self._kept.after(0, Ring.kept_bytes):
                    way.outbox.put(number, message)
            for key in self._links.keys() - links.keys():
                self._selection.left(key)
                self._said.pop(key, None)
            self._links = dict(links)

    def tick(self) -> None:
        """Send due messages and pulls. Not from a link's thread."""
        with self._lock:
            self._send()
        now = self._clock()
        if now - self._looked_at <= _LOOK_EVERY_S:
            return
        self._looked_at, (then, before_count) = now, self._counted
        self._counted = (now, self.count["messages"])
        self._rate_hz = (self.count["messages"] - before_count) / (now - then)
        if end := self._subscription or self._publisher:
            before, self.trouble = self.trouble, end.mismatch()
            if self.trouble not in ("", before):
                log.error("topic_not_heard topic=%s reason=%r", self.topic.name, self.trouble)

    def _send(self) -> None:
        now = self._clock()
        for key, link in self._links.items():
            way = self._ways.get(key)
            if way is None or now < way.rest_until:
                continue
            if self.topic.origin is Origin.ROBOT:
                self._send_messages(way, link)
            elif not (self.topic.latched or self._selection.wants(key, now)):
                way.session = frames.NO_SESSION  # a later pull begins with the messages of then
            elif not way.out:
                way.pulled_at = now
                pull = frames.encode_pull(way.session, way.after)
                self._offer(way, link, 0, pull, _PULL_S)

    def _send_messages(self, way: _Way, link: Link) -> None:
        if way.out and way.offer != link.offer:
            return  # messages on a new connection would overtake them
        way.offer = link.offer
        while (one := way.outbox.next()) is not None:
            frame = frames.encode_message(self._session, *one)
            if not self._offer(way, link, one[0], frame, _MESSAGE_S):
                way.outbox.returned([one[0]])
                return

    def _offer(self, way: _Way, link: Link, number: int, frame: bytes, limit_s: float) -> bool:
        id = os.urandom(REQUEST_ID_BYTES)
        way.out[id] = number  # first: the answer may come before `offer` returns
        if link.offer(self.topic.key_name, id, frame, limit_s):
            return True
        way.out.pop(id, None)
        return False

    # -- answers (the links' threads) -----------------------------------------------------

    def answered(self, key: int, answer: Answer) -> None:
        """Take the end of an attempt: a confirmed message, an answered pull, or a failure."""
        with self._lock:
            way = self._ways.get(key)
            number = None if way is None else way.out.pop(answer.request_id, None)
            if way is None or number is None:
                return
            if answer.payload is None:
                self._refused(way, number, answer.refusal or Refusal.LOST)
            elif number:
                way.outbox.confirmed(number)
                if number in self._unconfirmed:
                    del self._unconfirmed[number]
                    self.count["passed"] += 1
            else:
                self._take(key, way, answer.payload)
            due = not number or way.outbox.waiting
        if due:
            self._wake()

    def _refused(self, way: _Way, number: int, reason: Refusal) -> None:
        self.count["refused"] += 1
        if reason != Refusal.LOST:
            way.rest_until = self._clock() + _AGAIN_S
        if reason == Refusal.MALFORMED or not self.topic.reliable:
            way.outbox.confirmed(number)  # sending it again would not help, or is not required
        elif number:
            way.outbox.returned([number])

    def _take(self, key: int, way: _Way, frame: bytes) -> None:
        try:
            session, after, messages = frames.decode_batch(frame)
        except FrameError as error:
            self._misread(key, str(error))
            way.rest_until = self._clock() + _AGAIN_S
            return
        first = way.after if session == way.session else after
        now, begins = self._clock(), way.session == frames.NO_SESSION
        if messages and session == way.session:
            self.count["dropped"] += max(0, messages[0][0] - first - 1)
        way.session, way.after = session, after
        new = [message for number, message in messages if number > first]
        if not (new or begins) and now - way.pulled_at < _AT_ONCE_S:
            way.rest_until = now + _AGAIN_S
        for message in new:
            self.count["messages"] += 1
            self._pass(key, message, now)

    def _misread(self, key: int, fault: str) -> None:
        """Count a malformed message against its replica."""
        self.malformed[key] += 1
        self.count["refused"] += 1
        if worth_logging(self.malformed[key]):
            log.error("message_malformed topic=%s replica=%s count=%d reason=%r",
                      self.topic.name, short(key), self.malformed[key], fault)  # fmt: skip

    def _pass(self, key: int, message: bytes, now: float) -> None:
        if self._publisher is None:
            return
        try:
            if self.topic.select is Select.STATUS and len(message) > _STATUS_BYTES:
                self.count["dropped"] += 1  # an action with many goals: not the replica's fault
                return
            self._publisher.check(message)  # first: a malformed message must not be selected
        except Unreadable as error:
            self._misread(key, error.message)
            return
        if self.topic.select is Select.STATUS:
            self._said[key] = message
            merged = self._merge(self._said)
            if merged is None or merged == self._told:
                return
            self._told = message = merged
        elif not self._selection.passes(key, message, now):
            self.count["dropped"] += 1
            return
        try:
            self._publisher.publish(message)
            self.count["passed"] += 1
        except RosError as error:
            self.count["refused"] += 1
            log.warning("message_not_published topic=%s reason=%r", self.topic.name, error.message)


@dataclass(eq=False)
class TopicsOnRobot:
    """The topics of one client proxy."""

    wake: Callable[[], None]
    merge: Merge = lambda said: None
    clock: Callable[[], float] = time.monotonic
    _topics: dict[str, RobotTopic] = field(default_factory=dict, init=False)
    _trouble: dict[str, str] = field(default_factory=dict, init=False)

    def serve(self, topics: Iterable[TopicSpec], node: SerialisedNode) -> bool:
        """Forward exactly these topics; return whether they have changed."""
        wanted = {topic.key_name: topic for topic in topics}
        changed = False
        for name, old in list(self._topics.items()):
            if wanted.get(name) != old.topic:
                old.close()
                del self._topics[name]
                changed = True
        for name, topic in wanted.items():
            if name in self._topics:
                continue
            one = RobotTopic(topic, self.clock, self.wake, self.merge)
            try:
                one.open(node)
            except RosError as error:
                log.error("topic_not_passed topic=%s reason=%r", topic.name, error.message)
                self._trouble[topic.name] = error.message
                continue
            self._trouble.pop(topic.name, None)
            self._topics[name] = one
            changed = True
            log.info("topic_passed topic=%s origin=%s", topic.name, topic.origin.value)
        return changed

    def types(self) -> dict[str, str]:
        """Return the type of each topic, by its name on the link."""
        return {name: one.topic.type for name, one in self._topics.items()}

    def route(self, links: Mapping[int, Link], differ: Mapping[int, Collection[str]] = {}) -> None:
        """Set the links to all replicas and, by replica key, the topics whose types differ."""
        for name, one in self._topics.items():
            fit = {k: link for k, link in links.items() if name not in differ.get(k, ())}
            one.route({k: link for k, link in fit.items() if name in link.ready}, links)

    def answered(self, key: int, answer: Answer) -> None:
        """Pass the end of an attempt to its topic."""
        topic = self._topics.get(answer.service)
        if topic is not None:  # else it is no longer forwarded
            topic.answered(key, answer)

    def misreads(self, key: int) -> bool:
        """Whether a replica's messages were repeatedly malformed."""
        return any(one.malformed[key] >= MALFORMED_LIMIT for one in self._topics.values())

    def __len__(self) -> int:
        return len(self._topics)

    def tick(self) -> None:
        """Send due messages and pulls of all topics."""
        for one in self._topics.values():
            one.tick()

    def report(self) -> dict[str, Any]:
        """Return counters by topic, with the reason if one does not get through."""
        counts = {one.topic.name: one.report() for one in self._topics.values()}
        return {**counts, **{name: {"trouble": why} for name, why in self._trouble.items()}}

    def close(self) -> None:
        """Close all publishers and subscriptions."""
        for one in self._topics.values():
            one.close()
