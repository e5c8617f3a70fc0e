"""A replica of a stateful service: apply requests strictly by number, one at a time. Pure.

Events come in as method calls; actions are returned as effects, in order. The service runs one call
at a time, identified by a serial number; the end of a call with an older one is ignored.

Protocol: docs/design/state.md.
"""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Generic, TypeVar

from fogft.model.refusal import Refusal
from fogft.ordering import orders
from fogft.ordering.orders import START, Op, Position, Promise

T = TypeVar("T")


@dataclass(frozen=True)
class Reply(Generic[T]):
    """Answer the sender of this order."""

    to: T
    payload: bytes


@dataclass(frozen=True)
class Refuse(Generic[T]):
    """Refuse the sender of this order."""

    to: T
    reason: Refusal
    detail: str = ""


@dataclass(frozen=True)
class Begin:
    """Call the service (`APPLY`) or a state service; report its end by `done` with the serial."""

    op: Op
    serial: int
    payload: bytes = b""


Effect = Reply[T] | Refuse[T] | Begin


@dataclass
class _Work(Generic[T]):
    op: Op
    serial: int
    epoch: int
    index: int
    waiting: list[T]


class OrderedReplica(Generic[T]):
    """One stateful service on one replica."""

    queue_limit, queue_bytes = 512, 64 << 20  # queued requests; more are refused
    kept_limit, kept_bytes = 1024, 16 << 20  # answers kept for repeats; oldest dropped first

    def __init__(self) -> None:
        self.position = START
        self.sound, self.joined = True, False
        self.serving = False  # whether the service and its two state services are available
        self.promised, self.robot = 0, ""  # the term that it obeys, and whose term it is
        self.goal = 0  # the last number when it joined: it has caught up once that is applied
        self._serial = 0
        self._work: _Work[T] | None = None
        # By number: the request, and the senders to answer.
        self._queue: OrderedDict[int, tuple[bytes, list[T]]] = OrderedDict()
        self._queued_bytes = 0
        self._claims: list[T] = []
        self._snapshots: list[T] = []
        self._restore: tuple[int, bytes, T] | None = None
        self.kept: OrderedDict[int, bytes | None] = OrderedDict()
        self._kept_size = 0

    @property
    def current(self) -> bool:
        """Whether it has the current state: it joined, and has caught up since."""
        return self.joined and self.serving and self.position.index >= self.goal

    def works_on(self, serial: int) -> bool:
        """Whether the call with this serial is the current one."""
        return self._work is not None and self._work.serial == serial

    @property
    def in_flight(self) -> int:
        """The number of requests that are held and not answered yet."""
        applying = self._work is not None and self._work.op is Op.APPLY
        return len(self._queue) + applying

    @property
    def _expected(self) -> int:
        if self._queue:
            return next(reversed(self._queue)) + 1
        work = self._work
        at = work if work is not None and work.op is Op.APPLY else self.position
        return at.index + 1

    # -- orders ---------------------------------------------------------------------------

    def order(  # noqa: PLR0911 - one line an operation reads better than nesting
        self, op: Op, epoch: int, index: int, payload: bytes, *, robot: str, to: T
    ) -> list[Effect[T]]:
        """Take an order; `to` identifies the sender to answer."""
        if self.robot not in ("", robot):  # another robot, even with the right term
            return [Refuse(to, Refusal.HELD, self.robot[:48])]
        if op is Op.CLAIM:
            return self._claim(epoch, robot, to)
        if epoch != self.promised:
            return [self._fenced(to)]
        if op is Op.APPLY:
            return self._apply(index, payload, to)
        if op is Op.RECALL:
            known = self._recall(index, to)
            return [Refuse(to, Refusal.NOT_JOINED)] if known is None else known
        if not self.serving:
            return [Refuse(to, Refusal.NOT_READY)]
        if op is Op.JOIN:
            return self._join(payload, to)
        if op is Op.RESTORE:
            return self._take_restore(index, payload, to)
        self._snapshots.append(to)
        return self._go_on()

    def _claim(self, epoch: int, robot: str, to: T) -> list[Effect[T]]:
        if not self.serving:
            return [Refuse(to, Refusal.NOT_READY)]
        if epoch < self.promised:
            return [self._fenced(to)]
        out: list[Effect[T]] = []
        if epoch > self.promised:
            out = self._give_up(Refusal.FENCED, f"{epoch:x}")
            self.promised, self.robot = epoch, robot
            self.joined = False
        self._claims.append(to)
        return [*out, *self._go_on()]

    def _fenced(self, to: T) -> Refuse[T]:
        return Refuse(to, Refusal.FENCED, f"{self.promised:x}")

    def _join(self, payload: bytes, to: T) -> list[Effect[T]]:
        if not self.joined:
            at, goal = orders.decode_join(payload)
            if not self.sound or self._work is not None or at != self.position:
                return [Refuse(to, Refusal.NOT_JOINED)]
            self.joined, self.goal = True, goal
            if at.epoch != self.promised:
                self._forget_answers()
                self.position = Position(self.promised, at.index)
        return [self._has_joined(to)]

    def _is_behind(self, index: int) -> bool:
        """Whether it is already past the state after this number."""
        return self.joined and index < self._expected

    def _has_joined(self, to: T) -> Reply[T]:
        return Reply(to, orders.encode_index(self._expected))

    def _take_restore(self, index: int, payload: bytes, to: T) -> list[Effect[T]]:
        if self._is_behind(index):  # a repeat, or not needed
            return [self._has_joined(to)]
        goal, state = orders.decode_snapshot(payload)
        out: list[Effect[T]] = self._give_up(Refusal.NOT_JOINED) if self.joined else []
        self.joined = False
        if self._restore is not None:
            out.append(Refuse(self._restore[2], Refusal.NOT_JOINED))
        self._restore, self.goal = (index, state, to), goal
        return [*out, *self._go_on()]

    def _recall(self, index: int, to: T) -> list[Effect[T]] | None:
        """Answer a number received before, now or once it is applied; None for a new number."""
        if not self.joined:
            return [Refuse(to, Refusal.NOT_JOINED)]
        if index <= self.position.index:
            if index not in self.kept:
                return [Refuse(to, Refusal.FORGOTTEN)]
            return [self._answer(to, self.kept[index])]
        work = self._work
        if work is not None and work.op is Op.APPLY and work.index == index:
            work.waiting.append(to)
            return []
        if index in self._queue:
            self._queue[index][1].append(to)
            return []
        return None

    def _answer(self, to: T, answer: bytes | None) -> Effect[T]:
        return Refuse(to, Refusal.MALFORMED) if answer is None else Reply(to, answer)

    def _apply(self, index: int, payload: bytes, to: T) -> list[Effect[T]]:
        known = self._recall(index, to)
        if known is not None:
            return known
        if index != self._expected:
            return [Refuse(to, Refusal.GAP, str(self._expected))]
        held_bytes = self._queued_bytes + len(payload)
        full = len(self._queue) >= self.queue_limit or held_bytes > self.queue_bytes
        if full and self._queue:
            return [Refuse(to, Refusal.GAP, str(index))]  # to be resent a little later
        self._queue[index] = payload, [to]
        self._queued_bytes += len(payload)
        return self._go_on()

    # -- the service ----------------------------------------------------------------------

    def _go_on(self) -> list[Effect[T]]:
        if self._work is not None:  # a claim within our own term only asks for our position
            return self._tell() if self.joined else []
        out = self._tell()
        if self._restore is not None:
            index, payload, to = self._restore
            self._restore = None
            if self._is_behind(index):
                out.append(self._has_joined(to))
            else:
                # It may have joined by another restore meanwhile: orders since then are void.
                out += self._give_up(Refusal.NOT_JOINED)
                self.joined = self.sound = False
                self._forget_answers()
                return [*out, self._begin(Op.RESTORE, index, [to], payload)]
        if self._snapshots and self.joined:
            waiting, self._snapshots = self._snapshots, []
            return [*out, self._begin(Op.SNAPSHOT, self.position.index, waiting)]
        out += [Refuse(to, Refusal.NOT_JOINED) for to in self._snapshots]
        self._snapshots = []
        while self._queue and self._work is None:
            index, (payload, waiting) = self._queue.popitem(last=False)
            self._queued_bytes -= len(payload)
            out.append(self._begin(Op.APPLY, index, waiting, payload))
        return out

    def _tell(self) -> list[Effect[T]]:
        claims, self._claims = self._claims, []
        promise = orders.encode_promise(Promise(self.position, self.sound))
        return [Reply(to, promise) for to in claims]

    def _begin(self, op: Op, index: int, waiting: list[T], payload: bytes = b"") -> Begin:
        self._serial += 1
        self._work = _Work(op, self._serial, self.promised, index, waiting)
        return Begin(op, self._serial, payload)

    def done(self, serial: int, answer: bytes | None) -> list[Effect[T]]:
        """Note that the call with this serial has ended; `answer` is None if it failed.

        A request that could not be read counts as applied: the outcome is the same on all replicas.
        """
        work = self._work
        if work is None or work.serial != serial:
            return []
        self._work = None
        out: list[Effect[T]]
        if work.op is Op.APPLY:
            self.position = Position(work.epoch, work.index)
            self._keep(work.index, answer)
            out = [self._answer(to, answer) for to in work.waiting]
        elif work.op is Op.SNAPSHOT:
            out = [
                Refuse(to, Refusal.NOT_READY)
                if answer is None
                else Reply(to, orders.encode_snapshot(work.index, answer))
                for to in work.waiting
            ]
        else:
            out = self._restored(work, answer is not None)
        return [*out, *self._go_on()]

    def _restored(self, work: _Work[T], ok: bool) -> list[Effect[T]]:
        if not ok:  # the resulting state is unknown
            return [Refuse(to, Refusal.NOT_JOINED) for to in work.waiting]
        self.sound = True
        self.position = Position(work.epoch, work.index)
        if work.epoch != self.promised:  # fenced meanwhile
            return [self._fenced(to) for to in work.waiting]
        self.joined = True
        return [self._has_joined(to) for to in work.waiting]

    def _keep(self, index: int, answer: bytes | None) -> None:
        self.kept[index] = answer
        self._kept_size += len(answer or b"")
        while len(self.kept) > self.kept_limit or (
            self._kept_size > self.kept_bytes and len(self.kept) > 1
        ):
            _, oldest = self.kept.popitem(last=False)
            self._kept_size -= len(oldest or b"")

    def _forget_answers(self) -> None:
        self.kept.clear()
        self._kept_size = 0

    # -- failures -------------------------------------------------------------------------

    def lost(self) -> list[Effect[T]]:
        """Note that the service died with its state: it restarts from its initial state."""
        out = self._give_up(Refusal.CRASHED)
        if self._work is not None:
            out += [Refuse(to, Refusal.CRASHED) for to in self._work.waiting]
        self._work = None
        self.position, self.sound, self.joined, self.serving = START, True, False, False
        self._forget_answers()
        return out

    def _give_up(self, reason: Refusal, detail: str = "") -> list[Effect[T]]:
        ended = [to for _, waiting in self._queue.values() for to in waiting]
        ended += self._snapshots
        if self._restore is not None:
            ended.append(self._restore[2])
        ended += self._claims
        self._queue.clear()
        self._queued_bytes = 0
        self._snapshots, self._restore, self._claims = [], None, []
        return [Refuse(to, reason, detail) for to in ended]
