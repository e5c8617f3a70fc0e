"""A sequencer, its replicas and their network. No time passes by itself: each step does one thing,
chosen by whoever drives the world.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from fogft.ordering import orders
from fogft.ordering.catching_up import OrderedLog
from fogft.ordering.orders import START
from fogft.ordering.peer import Order
from fogft.ordering.replica import OrderedReplica, Refuse
from fogft.ordering.sequencer import Sequencer
from tests.ordering.linearizability import Call
from tests.ordering.service_world import Asked, Letter, ServiceWorld, lost


@dataclass(eq=False)
class Sent:
    """An order on its way to a replica, until it ends: exactly once."""

    term: int
    order: Order
    open: bool = True


class World(ServiceWorld[Sent, OrderedReplica[Sent]]):
    """One robot's sequencer and its replicas.

    Args:
        step: See `ServiceWorld`.
        start: Likewise.
        log_entries: Of the sequencer.
    """

    def __init__(self, step: Any, start: Any, *, replicas: int = 3, log_entries: int = 16) -> None:
        super().__init__(step, start)
        self.pending: dict[int, Asked] = {}  # by number
        self.waiting: list[tuple[int, Asked]] = []
        self.mark = START  # on the robot's disk
        self.epoch = 0  # likewise
        OrderedLog.entries_limit = log_entries  # until the module ends: see conftest
        for _ in range(replicas):
            self.add_replica()
        self.sequencer = self.new_term()

    # -- faults and events ----------------------------------------------------------------

    def new_term(self) -> Sequencer:
        """The client proxy was killed and is back: only epoch and mark are left."""
        self.epoch = orders.next_epoch(self.epoch, nonce=7)
        for asked in self.pending.values():
            self.history.append(Call(asked.began, asked.asked))
        self.pending.clear()
        self.waiting.clear()
        self.sequencer = Sequencer(self.epoch, mark=self.mark)
        self.reach()
        return self.sequencer

    def add_replica(self) -> int:
        replica, self.next_replica = self.next_replica, self.next_replica + 1
        self.begin_process(replica, OrderedReplica())
        if replica >= 3 or hasattr(self, "sequencer"):
            self.reach()
        return replica

    def remove_replica(self, replica: int) -> None:
        """The machine is gone for good."""
        del self.hosts[replica]
        for letter in self.letters:
            if letter.sent.order.replica == replica:
                self.end(letter.sent, None, lost(letter.sent))
        self.reach()

    def reach(self) -> None:
        self.sequencer.reach(self.hosts, self.now)
        self.send()

    def ask(self, client: int, asked: Any) -> None:
        self.tell(Asked(self.now, asked, client))

    def tell(self, asked: Asked) -> None:
        payload = repr(asked.asked).encode()
        self.questions[payload] = asked.asked
        index = self.sequencer.submit(payload) if self.sequencer.ready else None
        if index is None:
            self.waiting.append((asked.client, asked))
        else:
            self.pending[index] = asked
        self.send()

    def busy(self) -> set[int]:
        """Clients that wait for an answer."""
        return {a.client for a in self.pending.values()} | {client for client, _ in self.waiting}

    def give_up(self, client: int) -> None:
        """A caller's deadline has come."""
        for index, asked in list(self.pending.items()):
            if asked.client == client:
                del self.pending[index]
                self.sequencer.abandon(index)
                self.history.append(Call(asked.began, asked.asked))
        self.waiting = [(c, a) for c, a in self.waiting if c != client]

    def tick(self, seconds: float = 0.1) -> None:
        self.now += seconds
        self.sequencer.tick(self.now)
        if self.sequencer.ready:
            waiting, self.waiting = self.waiting, []
            for _, asked in waiting:
                self.tell(asked)
        self.send()

    # -- network --------------------------------------------------------------------------

    def send(self) -> None:
        for order in self.sequencer.take():
            self.letters.append(Letter(Sent(self.sequencer.epoch, order), to_replica=True))

    def arrive(self, sent: Sent) -> None:
        host = self.hosts.get(sent.order.replica)
        if host is None:
            self.end(sent, None, lost(sent))
            return
        order = sent.order
        id = orders.encode(order.op, sent.term, order.index)
        op, epoch, index = orders.decode(id)
        effects = host.machine.order(op, epoch, index, order.payload, robot="r", to=sent)
        self.effects(host, effects)

    def end(self, sent: Sent, payload: bytes | None, refused: Refuse[Sent] | None) -> None:
        if not sent.open:
            return
        sent.open = False
        order = sent.order
        if sent.term != self.sequencer.epoch:
            return  # an answer to a proxy that was killed
        if payload is None:
            assert refused is not None
            self.sequencer.refused(
                order.replica,
                order.op,
                order.index,
                refused.reason,
                self.now,
                detail=refused.detail,
            )
        else:
            first = self.sequencer.replied(order.replica, order.op, order.index, payload)
            if first:
                self.mark = self.sequencer.mark
                self.accepted(order, payload)
                asked = self.pending.pop(order.index, None)
                if asked is not None:
                    answer = eval(payload.decode())
                    self.history.append(Call(asked.began, asked.asked, self.now, answer))
        assert self.sequencer.deposed_by is None
        self.send()

    def accepted(self, order: Order, payload: bytes) -> None:
        """Note an answer that a caller sees."""

    # -- the end --------------------------------------------------------------------------

    def settle(self, limit: int = 20_000) -> None:
        """No more faults: let everything come to rest."""
        for _ in range(limit):
            self.now += 0.001
            working = self.working()
            if self.letters:
                self.deliver(0)
            elif working:
                self.work(working[0])
            elif self.at_rest():
                break
            else:
                self.tick(1.0)
        for asked in self.pending.values():
            self.history.append(Call(asked.began, asked.asked, math.inf))
        self.pending.clear()

    def at_rest(self) -> bool:
        machines = [host.machine for host in self.hosts.values()]
        places = {m.position for m in machines}
        joined = all(m.joined for m in machines) and len(places) == 1
        return joined and not self.letters and not self.waiting and not self.awaited()

    def awaited(self) -> bool:
        """Whether an answer is still to come: one that a replica keeps, or will have."""
        kept = [host.machine.kept for host in self.hosts.values()]
        last = max(host.machine.position.index for host in self.hosts.values())
        return any(index > last or any(index in k for k in kept) for index in self.pending)
