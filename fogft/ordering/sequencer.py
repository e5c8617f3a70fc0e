"""One term of a stateful service's order: the first answer counts. Pure.

It begins from the state of one replica, never from one before the mark, and one replica is
enough. When most of the replicas that stay run another version, that takes over at one point of
the order.

Owns: from what a term begins, which answer is returned, and when it is handed over.
Not here: numbers and how replicas come to them (`term`), callers and deadlines
(`fogft.proxy.robot.ordered_dispatcher`). Protocol and its argument: docs/design/state.md.
"""

from __future__ import annotations

from dataclasses import dataclass

from fogft.ordering.active_version import ActiveVersion
from fogft.ordering.orders import START, Op, Position
from fogft.ordering.peer import Order, Peer, Phase
from fogft.ordering.term import OrderedTerm


@dataclass(frozen=True)
class Handover:
    """From what a term begins in which another version becomes active.

    Attributes:
        version: The one that becomes active.
        at: The state that it takes over: every number given before has been applied there.
        state: Its bytes.
    """

    version: str
    at: Position
    state: bytes


class Sequencer(OrderedTerm):
    """One term of a sequencer.

    Args:
        epoch: This term, above every earlier one.
        mark: The position of the last answer that was returned, in whatever term.
        holder: The version that returned it; None where nobody knows.
        begin: What the term begins from, where a version takes over from another.
        log_entries: Requests kept at most.
        log_bytes: Their bytes at most.
    """

    def __init__(
        self,
        epoch: int,
        *,
        mark: Position = START,
        holder: str | None = None,
        begin: Handover | None = None,
        log_entries: int = 8192,
        log_bytes: int = 64 << 20,
    ) -> None:
        super().__init__(epoch, mark=mark, log_entries=log_entries, log_bytes=log_bytes)
        self.active = ActiveVersion(begin.version if begin else holder)
        self.handover: Handover | None = None  # this term's end: the next begins from it
        self._begin = begin
        self._change_to: str | None = None  # no number is given meanwhile
        self._unanswered: dict[int, None] = {}
        if begin is not None:
            self._begin_at(begin.at)
            self._keep_checkpoint(begin.at.index, begin.state)

    @property
    def changing(self) -> bool:
        """Whether another version is to take over as soon as all is answered."""
        return self._change_to is not None

    def submit(self, payload: bytes) -> int | None:
        """Number a request and order it applied; None while the term has not begun or is full."""
        if self._change_to is not None:
            return None
        index = self._append(payload)
        if index is not None:
            self._unanswered[index] = None
        return index

    def abandon(self, index: int) -> None:
        """Nobody waits for the answer to this number any more. It is applied all the same."""
        self._unanswered.pop(index, None)

    def _counts(self, replica: int) -> bool:
        return self.active.counts(self._version(replica))

    def _applied(self, replica: int, index: int, payload: bytes) -> bool:
        first = index in self._unanswered and self._counts(replica)
        if first:
            del self._unanswered[index]
            # Answers to later numbers imply all earlier ones; a mark never goes back.
            self.mark = max(self.mark, Position(self.epoch, index))
        return first

    def _recall(self, replica: int, before: int) -> None:
        peer = self._peers[replica]
        for index in self._unanswered:
            if index < before and index not in peer.open:
                peer.open.add(index)
                self._out.append(Order(replica, Op.RECALL, index))

    # -- how a term begins ----------------------------------------------------------------

    def _lead(self, replica: int, peer: Peer) -> None:
        """Begin the term from the state of a replica, if it may be."""
        promise = peer.promise
        if promise is None or not promise.sound or promise.position < self.mark:
            return
        if not self.active.may_lead(self._version(replica)):
            return
        self.active.version = self._version(replica)
        self._begin_at(promise.position)
        self._bring_all()

    def _find_base(self) -> None:
        for replica, peer in self._peers.items():
            if self.base is None and peer.phase is Phase.CLAIMED:
                self._lead(replica, peer)

    def _has_own_state(self, replica: int, at: Position) -> bool:
        """Whether a replica's state is one that this term knows, and not one it stood by with."""
        of_another = self._begin is not None and self._counts(replica) and at.epoch != self.epoch
        # One of the version that took over begins from what was handed over.
        return not of_another and super()._has_own_state(replica, at)

    # -- versions -------------------------------------------------------------------------

    def _govern(self, now: float) -> None:
        """Have a version take over: by a handover, or because the active one is gone."""
        joined = self.joined
        standing = [self._version(r) for r in joined]
        self.active.look(standing, now)
        if self.base is None:
            self._find_base()
        elif (heir := self.active.successor(standing)) is not None:
            self.active.version = heir
            self._change_to = None
            for replica in joined:
                if self._counts(replica):
                    self._recall(replica, self._peers[replica].next)
        elif self.handover is None:
            staying = [self._version(r) for r in joined if r not in self._leaving]
            self._change_to = self.active.wanted(staying)
            self._prepare_handover(now)

    def _prepare_handover(self, now: float) -> None:
        """Ask for the state after the last number, once that has been answered."""
        log = self.log
        if self._change_to is None or log is None or self._unanswered:
            return
        donors = [
            (r in self._leaving, p.won, r)
            for r, p in self._peers.items()
            if p.phase is Phase.JOINED and self._counts(r) and p.acked >= log.last and not p.open
        ]
        if donors and self._asked_for_checkpoint is None and now >= self._checkpoint_at:
            self._ask_for_checkpoint(min(donors)[-1], now)

    def _keep_checkpoint(self, index: int, state: bytes) -> None:
        super()._keep_checkpoint(index, state)
        log = self.log
        last = log is not None and index == log.last and not self._unanswered
        if self._change_to is not None and last:
            self.handover = Handover(self._change_to, Position(self.epoch, index), state)
