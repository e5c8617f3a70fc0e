"""Bring every replica of a stateful service through one term's log. Pure.

It holds what each replica still needs: requests by number while the log has them, else a
checkpoint and what came after. What is to be sent collects until `take`.

Owns: one term's numbers, its log and checkpoint, and what each replica is to be sent.
Not here: what replicas answer, and who obeys (`term`). Protocol: docs/design/state.md.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

from fogft.ordering import lag, orders
from fogft.ordering.log import Checkpoint, OrderedLog
from fogft.ordering.orders import Op, Position
from fogft.ordering.peer import Order, Peer, Phase

CHECKPOINT_RETRY_S = 1.0
WINDOW = 128


class CatchingUp(ABC):
    """A term's log, and how far each replica has come in it.

    Args:
        epoch: The term.
        log_entries: Requests kept at most.
        log_bytes: Their bytes at most.
    """

    def __init__(self, epoch: int, *, log_entries: int, log_bytes: int) -> None:
        self.epoch = epoch
        self.base: Position | None = None  # None until the term has begun
        self.log: OrderedLog | None = None
        self.deposed_by: int | None = None
        self._bounds = (log_entries, log_bytes)
        self._peers: dict[int, Peer] = {}
        self._out: list[Order] = []
        self._serial = 0
        self._asked_for_checkpoint: int | None = None
        self._checkpoint_at = 0.0

    # -- what differs ---------------------------------------------------------------------

    @abstractmethod
    def _counts(self, replica: int) -> bool:
        """Whether this replica's state may be given to others, and its answer to a caller."""

    def _has_own_state(self, replica: int, at: Position) -> bool:
        """Whether a replica's state is one that this term knows."""
        return at.epoch == self.epoch or at == self.base

    # -- what the owner asks --------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Whether a number given now is sent at once to somebody whose answer counts."""
        return any(
            peer.phase is Phase.JOINED and self._counts(replica)
            for replica, peer in self._peers.items()
        )

    @property
    def sends(self) -> bool:
        """Whether `take` has something to send."""
        return bool(self._out)

    @property
    def joined(self) -> list[int]:
        """The replicas that apply what is sent to them."""
        return [replica for replica, peer in self._peers.items() if peer.phase is Phase.JOINED]

    def take(self) -> list[Order]:
        """Return the orders to send, in this order, and forget them."""
        out, self._out = self._out, []
        return out

    # -- numbers --------------------------------------------------------------------------

    def _order(self, replica: int, op: Op, payload: bytes = b"") -> None:
        """Send an order that is about no number: it is told apart by a serial."""
        self._serial += 1
        self._out.append(Order(replica, op, self._serial, payload))

    def _begin_at(self, position: Position) -> None:
        entries, size = self._bounds
        self.base = position
        self.log = OrderedLog(position.index, entries_limit=entries, bytes_limit=size)

    def _append(self, payload: bytes) -> int | None:
        """Number some bytes and order them applied; None where there is no room."""
        log = self.log
        if log is None or self.deposed_by is not None:
            return None
        if not log.has_room(len(payload)) and not self._make_room(len(payload)):
            return None
        index = log.append(payload)
        for replica, peer in self._peers.items():
            if peer.phase is not Phase.JOINED:
                continue
            if peer.next == index and peer.rewind is None and len(peer.open) < WINDOW:
                peer.next = index + 1
                peer.open.add(index)
                self._out.append(Order(replica, Op.APPLY, index, payload))
        return index

    def _feed(self, replica: int, peer: Peer) -> None:
        log = self.log
        assert log is not None
        if peer.phase is not Phase.JOINED or peer.lags:
            return
        if peer.rewind is not None:
            if peer.open:
                return
            peer.next, peer.rewind = peer.rewind, None
        if not log.covers(peer.next - 1):
            peer.pause(0.0)
            return
        while peer.next <= log.last and len(peer.open) < WINDOW:
            index = peer.next
            peer.next += 1
            if index not in peer.open:
                peer.open.add(index)
                self._out.append(Order(replica, Op.APPLY, index, log.get(index)))

    def _make_room(self, size: int) -> bool:
        """No checkpoint came in time: drop what every member has applied, and no more.

        Each of them alone can then go on; only if all are lost at once, the state is.
        """
        log = self.log
        assert log is not None
        members = [p.acked for p in self._peers.values() if p.member]
        if members:
            log.drop(min(members))
        return log.has_room(size)

    # -- replicas that lack some ----------------------------------------------------------

    def _bring(self, replica: int, peer: Peer, *, waited: bool = False) -> None:
        """Let a claimed replica join, from its own state or from the checkpoint.

        Where both are long ago it waits for a new checkpoint, if there is whom to ask; `waited`
        says that it has.
        """
        log, promise = self.log, peer.promise
        if log is None or promise is None or peer.open:
            return
        at, kept = promise.position, log.checkpoint
        ours = self._has_own_state(replica, at)
        may_join = promise.sound and ours and log.covers(at.index)
        from_index = max(at.index if may_join else -1, kept.index if kept else -1)
        if log.last - from_index > lag.LIMIT and self.ready and not waited:
            return
        if may_join and from_index == at.index:
            peer.phase = Phase.ASKED
            self._out.append(Order(replica, Op.JOIN, at.index, orders.encode_join(at, log.last)))
        elif kept is not None:
            peer.phase = Phase.ASKED
            payload = orders.encode_snapshot(log.last, kept.state)
            self._out.append(Order(replica, Op.RESTORE, kept.index, payload))

    def _bring_all(self, *, waited: bool = False) -> None:
        for replica, peer in self._peers.items():
            if peer.phase is Phase.CLAIMED:
                self._bring(replica, peer, waited=waited)

    def _look_at_lag(self, peer: Peer, now: float) -> None:
        """Have a replica restored that falls behind, if another can give its state."""
        log = self.log
        if peer.phase is not Phase.JOINED or log is None:
            return
        given = any(
            self._keeps_up(other) and self._counts(replica)
            for replica, other in self._peers.items()
        )
        peer.lags = given and (peer.lags or peer.lag.too_far(log.last - peer.acked, now))
        if peer.lags and not peer.open:
            peer.lags, peer.phase, peer.retry_at = False, Phase.UNCLAIMED, now

    def _keeps_up(self, peer: Peer) -> bool:
        log = self.log
        return peer.phase is Phase.JOINED and log is not None and log.last - peer.acked <= WINDOW

    # -- the checkpoint -------------------------------------------------------------------

    def _see_to_checkpoint(self, now: float) -> None:
        log = self.log
        if log is None or self._asked_for_checkpoint is not None or now < self._checkpoint_at:
            return
        waits = any(p.phase is Phase.CLAIMED for p in self._peers.values())
        # A log that begins with the service's first state needs none; nor does one just taken.
        begins_later = log.checkpoint is None and log.start > 0
        if not (waits or begins_later or log.half_full):
            return
        joined = [
            (not self._keeps_up(p), p.won, r)
            for r, p in self._peers.items()
            if p.phase is Phase.JOINED and self._counts(r)
        ]
        if joined:  # one that seldom answers first: it pauses for the snapshot
            self._ask_for_checkpoint(min(joined)[-1], now)

    def _ask_for_checkpoint(self, replica: int, now: float) -> None:
        self._asked_for_checkpoint = replica
        self._checkpoint_at = now + CHECKPOINT_RETRY_S
        self._order(replica, Op.SNAPSHOT)

    def _take_checkpoint(self, index: int, state: bytes) -> None:
        if self.log is not None and self.deposed_by is None:
            self._keep_checkpoint(index, state)
            self._checkpoint_at = 0.0
            self._bring_all(waited=True)

    def _keep_checkpoint(self, index: int, state: bytes) -> None:
        assert self.log is not None
        self.log.keep(Checkpoint(index, state))
