"""One of several robots that share a stateful service: have each request answered once. Pure.

While another robot sequences, requests are handed in at a replica, which passes them on. When
most of the members have not heard of the sequencer for a while, this robot claims a term. A
request keeps its id whoever numbers it, so it is applied once.

Owns: this robot's requests until they are answered, and when it claims.
Not here: its term (`shared_sequencer`), callers and deadlines (`fogft.proxy.shared_order`).
Protocol and its argument: docs/design/state.md, "Several robots".
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from fogft.core import shared_orders
from fogft.core.shared_orders import RequestId, Standing
from fogft.core.shared_places import Places
from fogft.core.shared_sequencer import Answered, SharedSequencer
from fogft.core.shared_watch import Watch
from fogft.ordering import orders
from fogft.ordering.orders import START, Op, OrderId, Position
from fogft.ordering.peer import Order

TROUBLE_AFTER_S = 10.0
RETRY_S = 1.0
RETRY_LIMIT_S = 8.0
REFUSED_RETRY_S = 0.05
# A robot has at most so many requests beyond the oldest that is not answered: replicas keep the
# answers to all of them.
AHEAD = 256
# The mark of a robot that has seen the service begun, and was answered nothing: after the state
# in which a service starts, before all that a term ever gave a number.
BEGUN = Position(0, 1)


class Outgoing(NamedTuple):
    """An order, and the term (or the session) that is part of its id."""

    epoch: int
    order: Order


@dataclass
class _Request:
    body: bytes
    next_at: float
    tries: int = 0


class SharedRobot:
    """This robot's part in a shared order.

    Args:
        session: 64 random bits, not 0: this run of the client proxy.
        new_epoch: Returns a term above another one that was never used.
        chance: Returns a number between 0 and 1 by chance.
        founders: With so many replicas a service may begin that never began.
        mark: The position of the last answer that this robot returned, or `BEGUN`.
        log_entries: Requests kept at most in a term of its own.
    """

    def __init__(
        self,
        session: int,
        new_epoch: Callable[[int], int],
        chance: Callable[[], float],
        *,
        founders: int = 3,
        mark: Position = START,
        log_entries: int = 8192,
    ) -> None:
        self.session = session
        self.mark = mark
        self.term: SharedSequencer | None = None
        self.founders = founders
        self._new_epoch = new_epoch
        self._chance = chance
        self._log_entries = log_entries
        self._requests: dict[int, _Request] = {}
        self._next_seq = 1
        self._began = False
        self._replicas: list[int] = []
        self._versions: Mapping[int, str] = {}
        self._leaving: tuple[int, ...] = ()
        self._listed = 0
        self._watch = Watch(chance())
        self._places = Places()
        self._now = 0.0
        self._ready_at: float | None = None
        self._serial = 0
        self._out: list[Outgoing] = []
        self._answered: list[Answered] = []

    # -- requests -------------------------------------------------------------------------

    @property
    def _founded(self) -> bool:
        """Whether the service has begun, at some time: then it never begins anew."""
        return self.mark != START

    @property
    def _floor(self) -> int:
        return next(iter(self._requests), self._next_seq)

    def submit(self, body: bytes, now: float) -> int | None:
        """Take a request; return its number, or None while too many wait for an answer."""
        if self._next_seq - self._floor >= AHEAD:
            return None
        seq = self._next_seq
        self._next_seq += 1
        self._requests[seq] = _Request(body, now)
        self._pass_on(seq, now)
        return seq

    def abandon(self, seq: int) -> None:
        """Nobody waits for the answer any more. It may be applied all the same, once."""
        self._requests.pop(seq, None)

    def _pass_on(self, seq: int, now: float) -> None:
        """Number a request, or hand it in where it will be numbered."""
        request, term = self._requests[seq], self.term
        id = RequestId(self.session, seq)
        if term is not None and term.base is not None:
            fresh = not term.under_way(id)
            known = term.number(id, self._floor, request.body, wanted=True)
            request.next_at = now + (RETRY_S if known else REFUSED_RETRY_S)
            if not known or not fresh or term.under_way(id):
                return  # if it is committed without an answer, a replica has it: ask there
        joined = self._watch.places(now) if term is None else term.joined
        replica = self._places.choose(joined, seq, request.tries)
        if replica is None:
            request.next_at = now + REFUSED_RETRY_S
            return
        self._places.begin(replica, seq, len(request.body))
        request.next_at = now + min(RETRY_S * 2**request.tries, RETRY_LIMIT_S)
        request.tries += 1
        payload = shared_orders.encode_word(self._floor, request.body)
        self._out.append(Outgoing(self.session, Order(replica, Op.HAND_IN, seq, payload)))

    def take_answers(self) -> list[Answered]:
        """Return the answers that have come, and forget them. First write down `mark`."""
        answered, self._answered = self._answered, []
        return answered

    def _take(self, answered: Answered) -> None:
        if self._requests.pop(answered.seq, None) is not None:
            self.mark = max(self.mark, answered.at)
            self._answered.append(answered)

    # -- what the owner asks --------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Whether a request taken now will be answered, as far as is known."""
        return self._watch.lives if self.term is None else self.term.ready

    @property
    def sends(self) -> bool:
        """Whether `take` has something to send."""
        return bool(self._out) or (self.term is not None and self.term.sends)

    @property
    def sequencer(self) -> str:
        """The robot that replicas obey, as far as is seen; empty for this one, or nobody."""
        return "" if self.term is not None else self._watch.sequencer

    @property
    def members(self) -> int:
        """How many members the service has, as far as is seen."""
        return self._watch.members

    @property
    def held_bytes(self) -> int:
        """Bytes of the requests that are kept."""
        log = self.term.log if self.term is not None else None
        return sum(len(r.body) for r in self._requests.values()) + (log.held_bytes if log else 0)

    @property
    def trouble(self) -> str:
        """Why the service cannot be had; empty if nothing is wrong."""
        if self._ready_at is None or self._now - self._ready_at < TROUBLE_AFTER_S:
            return ""
        if self.term is not None and self.term.behind:
            return "what this robot was answered is in no state that can be reached"
        here, listed = len(self._replicas), self._listed
        if not self._founded and (listed < self.founders or here < listed):
            wanted = max(self.founders, listed)
            return f"{here} of {wanted} replicas are here; to begin, all must be"
        members = self.term.members if self.term is not None else ()
        count = len(members) or self.members
        if not count:
            return "no replica that can be reached holds the state; see docs/design/state.md"
        return f"most of the {count} replicas that have the state are not here"

    def take(self) -> list[Outgoing]:
        """Return the orders to send, in this order, and forget them."""
        out, self._out = self._out, []
        if self.term is not None:
            out += [Outgoing(self.term.epoch, order) for order in self.term.take()]
        return out

    def reach(
        self,
        replicas: Iterable[int],
        now: float,
        *,
        versions: Mapping[int, str] | None = None,
        leaving: Iterable[int] = (),
        listed: int = 0,
    ) -> None:
        """Set which replicas can be sent to.

        Args:
            replicas: Them.
            now: In seconds.
            versions: What each runs; all the same unless told.
            leaving: Those that are to go soon.
            listed: How many the pool has, reached or not.
        """
        self._replicas = list(replicas)
        self._versions, self._leaving = versions or {}, tuple(leaving)
        self._listed = max(listed, len(self._replicas))
        self._watch.keep(self._replicas)
        self._reach_term(now)

    def _reach_term(self, now: float) -> None:
        if self.term is not None:
            self.term.listed = self._listed
            self.term.reach(
                self._replicas, now, versions=self._versions, leaving=self._leaving
            )  # fmt: skip

    # -- time -----------------------------------------------------------------------------

    def tick(self, now: float) -> None:
        """Do what is due: look, claim, hand in again."""
        self._now = now
        if self.ready or self._ready_at is None:
            self._ready_at = now
        self._look_after_term(now)
        if self.term is not None:
            self.term.tick(now)
            self._look_after_term(now)
        if self.term is None:
            self._look(now)
            begins = not self._founded and len(self._replicas) == self._listed
            founders = self.founders if begins else None
            if self._watch.is_silent(self._replicas, now, founders=founders):
                self._claim(now)
        for seq in [s for s, request in self._requests.items() if request.next_at <= now]:
            self._pass_on(seq, now)

    def _look_after_term(self, now: float) -> None:
        term = self.term
        if term is None:
            return
        for answered in term.take_answers():
            self._take(answered)
        if term.members and term.committed >= 1:
            self.mark = max(self.mark, BEGUN)
        if term.deposed_by is not None:
            self._watch.highest = max(self._watch.highest, term.deposed_by)
            self._watch.begin(now, self._chance())
            self.term = None
        elif term.base is not None and not self._began:
            self._began = True
        else:
            return
        for request in self._requests.values():
            request.next_at = now

    def _look(self, now: float) -> None:
        if not self._watch.is_due(now):
            return
        for replica in self._replicas:
            if self._watch.looks_at(replica):
                self._serial += 1
                self._out.append(Outgoing(self.session, Order(replica, Op.LOOK, self._serial)))

    def _claim(self, now: float) -> None:
        epoch = self._watch.highest = self._new_epoch(self._watch.highest)
        self._began = False
        self.term = SharedSequencer(
            epoch, mark=self.mark, founders=self.founders, may_found=not self._founded,
            log_entries=self._log_entries,
        )  # fmt: skip
        self._reach_term(now)

    # -- how orders end -------------------------------------------------------------------

    def replied(self, replica: int, order: OrderId, payload: bytes, now: float) -> None:
        """Take a reply. Raises OrderError."""
        op, epoch, index = order
        if op is Op.LOOK:
            self._watch.looked(replica)
            self._saw(replica, shared_orders.decode_standing(payload), now)
        elif op is Op.HAND_IN:
            at, answer = shared_orders.decode_answer(payload)
            if epoch == self.session:
                self._places.end(replica, index)
                self._take(Answered(index, at, answer))
        elif self.term is not None and epoch == self.term.epoch:
            self.term.replied(replica, op, index, payload)
            self._look_after_term(now)

    def _saw(self, replica: int, standing: Standing, now: float) -> None:
        if replica not in self._replicas:
            return
        self._watch.saw(replica, standing, now)
        if standing.begun:
            self.mark = max(self.mark, BEGUN)

    def refused(self, replica: int, order: OrderId, reason: str, now: float) -> None:
        """Take a refusal, or the loss of an order: the replica may or may not have obeyed it."""
        op, epoch, index = order
        if op is Op.LOOK:
            self._watch.looked(replica)
        elif op is Op.HAND_IN and epoch == self.session:
            self._places.end(replica, index)
            request = self._requests.get(index)
            if request is not None:
                final = reason == orders.MALFORMED
                request.next_at = float("inf") if final else now + REFUSED_RETRY_S
        elif op is not Op.HAND_IN and self.term and epoch == self.term.epoch:
            self.term.refused(replica, op, index, reason, now)
            self._look_after_term(now)

    def declined(self, replica: int, order: OrderId, now: float) -> None:
        """An order was not taken by the link: it was not sent."""
        op, epoch, index = order
        if op in (Op.LOOK, Op.HAND_IN):
            self.refused(replica, order, "", now)
        elif self.term and epoch == self.term.epoch:
            self.term.declined(replica, op, index, now)
