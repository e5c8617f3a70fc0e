"""Several robots that share a service, its replicas, and a network that loses, repeats, reorders
and may be cut between any robot and any replica. Each step does one thing, chosen from outside.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field
from typing import Any

from fogft.core.shared_replica import SharedReplica
from fogft.core.shared_robot import Outgoing, SharedRobot
from fogft.ordering import orders
from fogft.ordering.orders import START, Position
from tests.linearizability import Call
from tests.ordering.service_world import LOST, Asked, Host, Letter, ServiceWorld


@dataclass(eq=False)
class Sent:
    """An order on its way, until it ends: exactly once."""

    robot: Robot
    host: Host[Any]
    what: Outgoing


@dataclass(eq=False)
class Robot:
    """One run of a client proxy."""

    name: str
    brain: SharedRobot
    pending: dict[int, Asked] = field(default_factory=dict)


class SharedWorld(ServiceWorld[Sent, SharedReplica[Sent]]):
    """The whole of it, with one history of what all callers saw.

    Args:
        step: See `ServiceWorld`.
        start: Likewise.
        source: Chance.
        log_entries: Of a sequencer.
    """

    def __init__(
        self, step: Any, start: Any, source: random.Random, *,
        robots: int = 2, replicas: int = 3, log_entries: int = 64,
    ) -> None:  # fmt: skip
        super().__init__(step, start)
        self.source = source
        self.log_entries = log_entries
        self.open: dict[Sent, None] = {}  # orders that have not ended
        self.cut: set[tuple[str, int]] = set()
        self.robots: dict[str, Robot] = {}
        self.marks: dict[str, Position] = {}  # on the robots' disks
        self.epochs: dict[str, int] = {}  # likewise
        self.asked = 0
        self.moved = 0
        self.killed = 0  # calls whose proxy was killed
        self.sequencers: set[int] = set()
        for _ in range(replicas):
            self.add_replica()
        for number in range(robots):
            self.start_robot(f"r{number}")

    # -- faults and events ----------------------------------------------------------------

    def add_replica(self) -> int:
        replica, self.next_replica = self.next_replica, self.next_replica + 1
        self.begin_process(replica, self.new_machine())
        self.reach()
        return replica

    def new_machine(self) -> SharedReplica[Sent]:
        return SharedReplica(self.source.getrandbits(64))

    def kill_process(self, replica: int) -> None:
        """The server proxy is killed and started again: it remembers nothing."""
        self.lose_all(lambda sent: sent.host.replica == replica)
        self.begin_process(replica, self.new_machine())

    def remove_replica(self, replica: int) -> None:
        """The machine is gone for good."""
        del self.hosts[replica]
        self.lose_all(lambda sent: sent.host.replica == replica)
        self.reach()

    def start_robot(self, name: str) -> None:
        """A client proxy begins; one that was killed has only its epoch and its mark left."""

        def new_epoch(above: int) -> int:
            known = max(above, self.epochs.get(name, 0))
            self.epochs[name] = orders.next_epoch(known, self.source.getrandbits(32))
            return self.epochs[name]

        brain = SharedRobot(
            self.source.getrandbits(63) + 1, new_epoch, self.source.random,
            mark=self.marks.get(name, START), log_entries=self.log_entries,
        )  # fmt: skip
        self.robots[name] = Robot(name, brain)
        self.reach()

    def kill_robot(self, name: str) -> None:
        robot = self.robots.pop(name)
        self.killed += len(robot.pending)
        for asked in robot.pending.values():
            self.history.append(Call(asked.began, asked.asked))

    def reach(self) -> None:
        for robot in self.robots.values():
            near = [r for r in self.hosts if (robot.name, r) not in self.cut]
            robot.brain.reach(near, self.now, listed=len(self.hosts))
            self.send(robot)

    def cut_off(self, name: str, replica: int) -> None:
        self.cut.add((name, replica))
        self.lose_all(lambda sent: (sent.robot.name, sent.host.replica) == (name, replica))
        self.reach()

    def heal(self) -> None:
        self.cut.clear()
        self.reach()

    def lose_all(self, which: Any) -> None:
        for sent in [sent for sent in self.open if which(sent)]:
            self.end(sent, None, LOST)

    # -- callers --------------------------------------------------------------------------

    def ask(self, name: str, client: int, asked: Any) -> None:
        robot = self.robots[name]
        self.asked += 1
        payload = repr((self.asked, asked)).encode()
        self.questions[payload] = asked
        seq = robot.brain.submit(payload, self.now)
        assert seq is not None
        robot.pending[seq] = Asked(self.now, asked, client)
        self.send(robot)

    def busy(self, name: str) -> set[int]:
        return {asked.client for asked in self.robots[name].pending.values()}

    def give_up(self, name: str, client: int) -> None:
        """A caller's deadline has come."""
        robot = self.robots[name]
        for seq, asked in list(robot.pending.items()):
            if asked.client == client:
                del robot.pending[seq]
                robot.brain.abandon(seq)
                self.history.append(Call(asked.began, asked.asked))

    def take_answers(self, robot: Robot) -> None:
        answers = robot.brain.take_answers()
        self.marks[robot.name] = robot.brain.mark
        for answered in answers:
            asked = robot.pending.pop(answered.seq)
            answer = eval(answered.answer.decode())
            self.history.append(Call(asked.began, asked.asked, self.now, answer))

    def tick(self, seconds: float = 0.1) -> None:
        self.now += seconds
        for robot in self.robots.values():
            robot.brain.tick(self.now)
            self.take_answers(robot)
            self.send(robot)
            term = robot.brain.term
            if term is not None and term.base is not None and term.epoch not in self.sequencers:
                self.sequencers.add(term.epoch)
                self.moved += 1

    # -- network --------------------------------------------------------------------------

    def send(self, robot: Robot) -> None:
        for what in robot.brain.take():
            host = self.hosts.get(what.order.replica)
            if host is not None and (robot.name, host.replica) not in self.cut:
                sent = Sent(robot, host, what)
                self.open[sent] = None
                self.letters.append(Letter(sent, to_replica=True))
            else:
                id = (what.order.op, what.epoch, what.order.index)
                robot.brain.declined(what.order.replica, id, self.now)

    def arrive(self, sent: Sent) -> None:
        host = self.hosts.get(sent.host.replica)
        if host is None or (sent.robot.name, host.replica) in self.cut:
            self.end(sent, None, LOST)
            return
        order = sent.what.order
        op, epoch, index = orders.decode(
            orders.encode(order.op, sent.what.epoch, order.index)
        )  # fmt: skip
        effects = host.machine.order(
            op, epoch, index, order.payload, robot=sent.robot.name, to=sent
        )  # fmt: skip
        self.effects(host, effects)

    def end(self, sent: Sent, payload: bytes | None, reason: str) -> None:
        if self.open.pop(sent, sent) is sent:
            return
        robot, order = sent.robot, sent.what.order
        if self.robots.get(robot.name) is not robot:
            return  # it was killed
        id = (order.op, sent.what.epoch, order.index)
        if payload is None:
            robot.brain.refused(order.replica, id, reason, self.now)
        else:
            robot.brain.replied(order.replica, id, payload, self.now)
        self.take_answers(robot)
        self.send(robot)

    def apply(self, host: Host[SharedReplica[Sent]], payload: bytes) -> Any:
        assert payload not in host.applied, "a request was applied twice"
        return super().apply(host, payload)

    # -- the end --------------------------------------------------------------------------

    def settle(self, limit: int = 30_000, until: Any = None) -> bool:
        """No more faults: let everything come to rest. Return whether it did."""
        until = until or self.at_rest
        for _ in range(limit):
            if until():
                break
            self.now += 0.0005
            working = self.working()
            if self.letters:
                self.deliver(0)
            elif working:
                self.work(working[0])
            else:
                self.tick(0.1)
        return bool(until())

    def finish(self) -> None:
        """Write down the calls that were never answered."""
        for robot in self.robots.values():
            for asked in robot.pending.values():
                self.history.append(Call(asked.began, asked.asked, math.inf))
            robot.pending.clear()

    def check(self) -> None:
        self.finish()
        super().check()

    def at_rest(self) -> bool:
        """Whether all is answered, and all replicas are in one state."""
        machines = [host.machine for host in self.hosts.values()]
        calm = not self.working() and not any(r.pending for r in self.robots.values())
        joined = all(m.current for m in machines) and len({m.position for m in machines}) == 1
        return calm and joined
