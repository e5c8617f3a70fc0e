"""Topics at a replica: publishes robots' messages, and keeps its nodes' messages for robots.

Owns: this replica's publishers and subscriptions, its ring buffers, and held pulls (long polls).
Design: docs/design/topics.md.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from itertools import count
from queue import SimpleQueue
from typing import TYPE_CHECKING, NamedTuple

from fogft.byte_limit import ByteLimit
from fogft.errors import FrameError, RosError, Unreadable
from fogft.link.port import Incoming
from fogft.model.refusal import Refusal
from fogft.model.topic import Origin, TopicSpec
from fogft.process import on_thread
from fogft.requests.fair_queue import FairQueue
from fogft.topics import frames
from fogft.topics.queues import Judgement, Ring, Seen

if TYPE_CHECKING:
    from fogft.ros.node import SerialisedNode
    from fogft.ros.topic_ends import Publisher, Subscription

log = logging.getLogger(__name__)

HOLD_S = 2.0
LOOK_EVERY_S = 2.0  # check whether publishers are heard
_HELD_LIMIT = 64  # held pulls of a topic; beyond it, the robot with most gets an empty answer
_BATCH_BYTES = 8 << 20
_AGAIN_S = 0.2  # a robot pauses for this long after a refusal
_WAITING_LIMIT = 1024  # messages waiting to be published, or pulls to be answered
_WAITING_BYTES = 64 << 20


class _Pull(NamedTuple):
    incoming: Incoming
    after: int
    until: float


class _Outgoing:
    """A topic published by nodes on this replica."""

    def __init__(self, topic: TopicSpec, session: bytes, clock: Callable[[], float]) -> None:
        self._ring = Ring(topic.depth, latched=topic.latched)
        self._session = session
        self._clock = clock
        self._lock = threading.Lock()
        self._held: list[_Pull] = []
        # By robot: the last message sent to it, and until when none is sent again.
        self._got: dict[str, tuple[int, float]] = {}

    def heard(self, message: bytes) -> None:
        with self._lock:
            self._ring.put(message)
            held, self._held = self._held, []
        for pull in held:
            self._answer(pull)

    def pulled(self, incoming: Incoming) -> None:
        session, after = frames.decode_pull(incoming.payload)
        hold_s = min(HOLD_S, incoming.remaining_s / 2)
        pull = _Pull(incoming, after, self._clock() + hold_s)
        due: _Pull | None = pull
        with self._lock:
            if session != self._session:
                after = self._ring.begin()
                incoming.reply(frames.encode_batch(self._session, after, ()))
                return
            if self._ring.last <= after:
                self._held.append(pull)
                due = self._excess()
        if due is not None:
            self._answer(due)

    def _excess(self) -> _Pull | None:
        """Stop holding one pull if there are too many: the oldest of the robot with most."""
        if len(self._held) <= _HELD_LIMIT:
            return None
        [(most, _)] = Counter(pull.incoming.robot for pull in self._held).most_common(1)
        excess = next(pull for pull in self._held if pull.incoming.robot == most)
        self._held.remove(excess)
        return excess

    def tick(self, now: float) -> None:
        """Answer pulls that were held for long enough."""
        with self._lock:
            over = [pull for pull in self._held if pull.until <= now]
            self._held = [pull for pull in self._held if pull.until > now]
        for pull in over:
            self._answer(pull)

    def _answer(self, pull: _Pull) -> None:
        now, robot = self._clock(), pull.incoming.robot
        with self._lock:
            found = self._ring.after(pull.after, _BATCH_BYTES)[: frames.BATCH_LIMIT]
            got, until = self._got.get(robot, (0, 0.0))
            repeats = bool(found) and pull.after < got
            again = repeats and now < until
            if found and not again:
                self._got[robot] = max(got, found[-1][0]), now + _AGAIN_S if repeats else until
        if again:
            pull.incoming.refuse(Refusal.OVERLOADED)
            return
        last = found[-1][0] if found else pull.after
        pull.incoming.reply(frames.encode_batch(self._session, last, found))


class _Inbox:
    """Messages or pulls from robots, taken by one thread: robots in turn, each in order."""

    def __init__(
        self, take: Callable[[Incoming], None], refuse: Callable[[Incoming], None]
    ) -> None:
        self._take, self._refuse = take, refuse
        self._lock = threading.Lock()
        self._waiting: FairQueue[Incoming] = FairQueue()
        self._large = ByteLimit(_WAITING_BYTES)
        self._count = count()
        self._due: SimpleQueue[bool] = SimpleQueue()  # one True per item put in; False to end

    def put(self, incoming: Incoming) -> None:
        """Queue a message or a pull; refuse it, or another one, if there is no room."""
        robot, size = incoming.robot, len(incoming.payload)
        excess: Incoming | None = None
        with self._lock:
            if not self._large.has_room(size, robot):
                excess = incoming
            elif self._waiting.size() >= _WAITING_LIMIT:
                excess = self._waiting.evict(robot, 0.0) or incoming
            if excess is not incoming:
                self._large.add(size, robot)
                self._waiting.put(b"%d" % next(self._count), robot, 0.0, incoming)
                self._due.put(True)
            if excess is not None and excess is not incoming:
                self._large.remove(len(excess.payload), excess.robot)
        if excess is not None:
            self._refuse(excess)

    def run(self) -> None:
        """Process incoming messages or pulls until closed."""
        while self._due.get():
            with self._lock:
                incoming = self._waiting.take()
                if incoming is not None:
                    self._large.remove(len(incoming.payload), incoming.robot)
            try:
                if incoming is not None:
                    self._take(incoming)
            except Exception:  # must not affect the others
                log.exception("message_not_taken")

    def close(self) -> None:
        """End `run`, once everything queued so far has been processed."""
        self._due.put(False)


class TopicsOnReplica:
    """The topics of one replica."""

    def __init__(
        self, topics: Iterable[TopicSpec], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._topics = {topic.key_name: topic for topic in topics}
        self.types = {name: topic.type for name, topic in self._topics.items()}
        self._clock = clock
        session = os.urandom(frames.SESSION_BYTES)
        self._outgoing = {
            name: _Outgoing(topic, session, clock)
            for name, topic in self._topics.items()
            if topic.origin is Origin.REPLICAS
        }
        self._publishers: dict[str, Publisher] = {}
        self._subscriptions: dict[str, Subscription] = {}
        self._looked_at = clock()
        self._seen = {name: Seen() for name in self._topics}
        self._trouble: dict[str, str] = {}
        # Robots' latched messages, to publish again when the command restarts.
        self._latched = {
            name: Ring(topic.depth if topic.latched else 0, latched=True)
            for name, topic in self._topics.items()
        }
        # Publishing may block briefly, and answers are copied: the link's threads must not do so.
        messages, pulls = (_Inbox(take, self._turn_away) for take in (self._publish, self._answer))
        self._messages, self._pulls, self.inboxes = messages, pulls, (messages, pulls)
        self._running = False
        # Until when a robot pauses on a topic: what comes meanwhile was in flight before.
        self._rests: dict[tuple[str, str], float] = {}

    def __bool__(self) -> bool:
        return bool(self._topics)

    def __contains__(self, name: str) -> bool:
        return name in self._topics

    @property
    def trouble(self) -> str:
        """Why a topic does not get through; empty if all do."""
        return next(iter(list(self._trouble.values())), "")  # `use` may add to them meanwhile

    def use(self, node: SerialisedNode | None) -> None:
        """Publish and subscribe with this node from now on; None for no node."""
        self._publishers, self._subscriptions, self._trouble = {}, {}, {}
        if node is None:
            return
        if not self._running:
            self._running = True
            for inbox in self.inboxes:
                on_thread(inbox.run, name="fogft-topics")
        for name, topic in self._topics.items():
            try:
                if topic.origin is Origin.ROBOT:
                    publisher = node.publisher(topic)
                    for _, message in self._latched[name].after(0, Ring.kept_bytes):
                        publisher.publish(message)
                    self._publishers[name] = publisher
                else:
                    heard = self._outgoing[name].heard
                    self._subscriptions[name] = node.subscribe(topic, heard)
            except RosError as error:
                self._note(name, error.message)
            else:
                self._note(name, "")

    def _note(self, name: str, trouble: str) -> None:
        if trouble and self._trouble.get(name) != trouble:
            log.error("topic_not_usable topic=%s reason=%r", self._topics[name].name, trouble)
        if trouble:
            self._trouble[name] = trouble
        else:
            self._trouble.pop(name, None)

    def ready(self) -> frozenset[str]:
        """Return the names of the topics that have an endpoint here."""
        publishers = self._publishers.copy()  # since `use` may add to them meanwhile
        heard = {name for name, one in publishers.items() if one.subscribers()}
        return frozenset(self._subscriptions) | heard

    def request(self, incoming: Incoming) -> None:
        """Take a message or a pull from the link. Never blocks."""
        name = incoming.service
        if name in self._outgoing:
            self._pulls.put(incoming)
        elif self._clock() < self._rests.get((name, incoming.robot), 0.0):
            incoming.refuse(Refusal.OVERLOADED)
        elif name in self._publishers:
            self._messages.put(incoming)
        else:
            self._turn_away(incoming, Refusal.NOT_READY)

    def _answer(self, incoming: Incoming) -> None:
        try:
            self._outgoing[incoming.service].pulled(incoming)
        except FrameError:
            incoming.refuse(Refusal.MALFORMED)

    def tick(self) -> None:
        """Answer pulls at their time limit. Call at about 10 Hz."""
        now = self._clock()
        for outgoing in self._outgoing.values():
            outgoing.tick(now)
        if now - self._looked_at > LOOK_EVERY_S:
            self._looked_at = now
            ends: dict[str, Publisher | Subscription] = {**self._publishers, **self._subscriptions}
            for name, end in ends.items():
                self._note(name, end.mismatch())

    def _publish(self, incoming: Incoming) -> None:
        """Publish a message, and confirm it to its robot."""
        name = incoming.service
        try:
            session, number, message = frames.decode_message(incoming.payload)
            publisher = self._publishers.get(name)
            if publisher is None:
                self._turn_away(incoming, Refusal.NOT_READY)
                return
            publisher.check(message)
            judged = self._seen[name].judge(incoming.robot, session, number)
            if judged is Judgement.LATE:
                raise FrameError("a later one was published")
            if judged is Judgement.NEW:
                self._latched[name].put(message)
                publisher.publish(message)
            incoming.reply(b"")
        except (FrameError, Unreadable) as error:
            log.warning("message_refused topic=%s reason=%r", name, str(error))
            incoming.refuse(Refusal.MALFORMED)
        except Exception:
            log.exception("message_not_published topic=%s", name)
            incoming.refuse(Refusal.NOT_READY)

    def _turn_away(self, incoming: Incoming, reason: Refusal = Refusal.OVERLOADED) -> None:
        """Refuse a pull, or a message and those in flight behind it, which would overtake it."""
        self._rests[incoming.service, incoming.robot] = self._clock() + _AGAIN_S
        incoming.refuse(reason)

    def close(self) -> None:
        """Stop publishing."""
        for inbox in self.inboxes:
            inbox.close()
