"""A replica of a stateful service that several robots share. Pure.

As `OrderedReplica`, and besides: it obeys whichever robot has the latest term; it holds what
robots hand in until the sequencer has it numbered, and answers it once a majority of the members
has applied it; it keeps the book of who asked what.

Owns: what robots handed in, the book, and whether this replica counts in a majority.
Not here: calling the service and answering (`fogft.proxy.replica.ordered_responder`).
Protocol and its argument: docs/design/state.md, "Several robots".
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from fogft.core import shared_book, shared_orders
from fogft.core.shared_book import Applied, Book
from fogft.core.shared_orders import OVERLOADED, Entry, Handed, RequestId, Standing, Vote
from fogft.ordering import orders
from fogft.ordering.orders import FORGOTTEN, MALFORMED, NOT_JOINED, Op, OrderError, Position
from fogft.ordering.replica import NOT_READY, Begin, Effect, OrderedReplica, Refuse, Reply

T = TypeVar("T")

HANDED_LIMIT = 512
HANDED_BYTES = 64 << 20


@dataclass
class _HandedIn(Generic[T]):
    """A request that a robot handed in here, until it is answered."""

    request: Handed
    waiting: list[T] = field(default_factory=list)
    told: bool = False  # the sequencer has it


class SharedReplica(OrderedReplica[T]):
    """One stateful service on one replica, ordered by whichever robot has the latest term.

    Args:
        member: 64 random bits: who this is. Another process is another member.
    """

    def __init__(self, member: int) -> None:
        super().__init__()
        self.member = member
        self.book = Book()
        self._life = 0
        self._whole = True
        self._heard = 0
        self._committed = 0  # by what the present term said; of no meaning before it is joined
        self._begun = False
        self._listener: T | None = None
        self._handed: OrderedDict[RequestId, _HandedIn[T]] = OrderedDict()
        self._entry = Entry()
        self._next_book = Book()

    def order(
        self, op: Op, epoch: int, index: int, payload: bytes, *, robot: str, to: T
    ) -> list[Effect[T]]:
        """Take an order; `to` is who is to be answered. Raises OrderError."""
        if op is Op.LOOK:
            return [Reply(to, self._standing().encode())]
        if op is Op.HAND_IN:
            return self._hand_in(RequestId(epoch, index), payload, to)
        self._heard += epoch == self.promised
        if op in (Op.JOIN, Op.RESTORE) and epoch == self.promised:
            # One that was sent before the service lost its state does not know of that.
            life, payload = shared_orders.decode_word(payload)
            if life != self._life:
                return [Refuse(to, NOT_JOINED)]
        if op is Op.RESTORE and epoch == self.promised:
            shared_book.decode(orders.decode_snapshot(payload)[1])
        if op is Op.LISTEN and epoch == self.promised:
            return self._listen(payload, to)
        return super().order(op, epoch, index, payload, robot=robot, to=to)

    @property
    def in_flight(self) -> int:
        """Requests that are held and not yet answered."""
        return super().in_flight + len(self._handed)

    # -- whom it obeys --------------------------------------------------------------------

    def _may_obey(self, robot: str) -> bool:
        return True

    def _claim(self, epoch: int, robot: str, to: T) -> list[Effect[T]]:
        self._look_whether_whole()
        before = self.promised
        out = super()._claim(epoch, robot, to)
        if self.promised != before:
            out = [*self._stop_listening(), *out]
            self._committed = 0
            self._tell_again()
        return out

    def _tell_again(self) -> None:
        for handed in self._handed.values():
            handed.told = False

    def _look_whether_whole(self) -> None:
        """One that lost its state has all it ever said to have once it is as far as the order."""
        self._whole = self._whole or (self.joined and self.position.index >= self.goal)

    def _promise(self) -> bytes:
        self._look_whether_whole()
        vote = Vote(
            self.position, self.sound, self._whole, self.member, self._life, self.book.members
        )
        return vote.encode()

    def _joined(self) -> bytes:
        return shared_orders.encode_joined(self.member, self._expected, self.position.index)

    def _standing(self) -> Standing:
        return Standing(
            self.promised, self._heard, self.joined and self.serving, self.member,
            self.book.members, self.robot, self._begun,
        )  # fmt: skip

    # -- what robots hand in --------------------------------------------------------------

    def _hand_in(self, id: RequestId, payload: bytes, to: T) -> list[Effect[T]]:
        floor, body = shared_orders.decode_word(payload)
        if not self.joined:
            return [Refuse(to, NOT_JOINED)]
        held = self._handed.get(id)
        if held is None:
            size = sum(len(h.request.body) for h in self._handed.values())
            if len(self._handed) >= HANDED_LIMIT or size + len(body) > HANDED_BYTES:
                return [Refuse(to, OVERLOADED)]
            held = self._handed[id] = _HandedIn(Handed(id, floor, body))
        held.waiting.append(to)
        held.told = False
        return [*self._settle(), *self._tell_listener()]

    def _settle(self) -> list[Effect[T]]:
        """Answer what was handed in and is now known to last."""
        if not self.joined:
            return []
        out: list[Effect[T]] = []
        for id, handed in list(self._handed.items()):
            applied = self.book.find(id)
            if applied is not None and applied.index <= self._committed:
                at = Position(self.promised, applied.index)
                answer = applied.answer
                out += [
                    Refuse(to, MALFORMED)
                    if answer is None
                    else Reply(to, shared_orders.encode_answer(at, answer))
                    for to in handed.waiting
                ]
            elif applied is None and self.book.forgets(id):
                out += [Refuse(to, FORGOTTEN) for to in handed.waiting]
            else:
                continue
            del self._handed[id]
        return out

    def _listen(self, payload: bytes, to: T) -> list[Effect[T]]:
        committed, again = shared_orders.decode_listen(payload)
        if again:
            self._tell_again()
        out = self._stop_listening()
        self._committed = max(self._committed, committed)
        self._begun = self._begun or committed > 0
        self._listener = to
        return [*out, *self._settle(), *self._tell_listener()]

    def _stop_listening(self) -> list[Effect[T]]:
        listener, self._listener = self._listener, None
        return [] if listener is None else [Reply(listener, b"")]

    def _tell_listener(self) -> list[Effect[T]]:
        """Tell the sequencer what it has not been told of, if it listens."""
        if self._listener is None or not self.joined:
            return []
        new = [h for h in self._handed.values() if not h.told and self.book.is_new(h.request.id)]
        if not new:
            return []
        for handed in new:
            handed.told = True
        listener, self._listener = self._listener, None
        return [Reply(listener, b"".join(handed.request.encode() for handed in new))]

    # -- the service ----------------------------------------------------------------------

    def _start(self, index: int, payload: bytes, waiting: list[T]) -> list[Effect[T]]:
        at = Position(self.promised, index)
        try:
            entry = self._entry = shared_orders.decode_entry(payload)
        except OrderError:
            entry = self._entry = Entry()
        if entry.members:
            self.book.members = entry.members
        elif entry.id.session and self.book.is_new(entry.id):
            return [self._begin(Op.APPLY, index, waiting, entry.body)]
        # The service is not called for it.
        known = self.book.find(entry.id)
        told = self._told(known.answer if known is not None else None)
        return [*super()._has_applied(at, told, waiting), *self._settle()]

    def _has_applied(self, at: Position, answer: bytes | None, waiting: list[T]) -> list[Effect[T]]:
        self.book.note(self._entry, Applied(at.index, answer))
        return [*super()._has_applied(at, self._told(answer), waiting), *self._settle()]

    def _told(self, answer: bytes | None) -> bytes:
        """Return what the sequencer is told of a number: the answer only where it wants it."""
        return shared_orders.encode_applied(self.member, answer if self._entry.wanted else None)

    def _snapshot_of(self, state: bytes) -> bytes:
        return self.book.encode() + state

    def _begin(self, op: Op, index: int, waiting: list[T], payload: bytes = b"") -> Begin:
        if op is Op.RESTORE:
            self._next_book, payload = shared_book.decode(payload)
        return super()._begin(op, index, waiting, payload)

    def _is_behind(self, index: int) -> bool:
        ahead = self.sound and self.position.epoch == self.promised
        return super()._is_behind(index) or (ahead and index < self.position.index)

    def _took_state(self, ok: bool) -> None:
        if ok:
            self.book = self._next_book
        else:
            self._lose()

    def lost(self) -> list[Effect[T]]:
        """The service has died, with its state: what starts next starts at the beginning."""
        out = [*self._stop_listening(), *super().lost()]
        for handed in self._handed.values():
            out += [Refuse(to, NOT_READY) for to in handed.waiting]
        self._handed.clear()
        self._lose()
        return out

    def _lose(self) -> None:
        """Say from now on that the state is gone; one that never was a member had none."""
        self._whole = self._whole and not self.book.members
        self._life += 1
        self.book = Book()
