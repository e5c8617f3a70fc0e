"""One term of a sequencer: give out numbers, and bring every replica through them. Pure.

A term claims the replicas, begins from the state of one of them, and from then on appends
requests to its log. It holds what each replica still needs. What is to be sent collects until
`take`; the owner sends it and reports each order's end, once, by `replied`, `refused` or
`declined`.

Owns: one term's numbers, its log and checkpoint, and what each replica is to be sent.
Not here: from what a term may begin and when an answer counts: `sequencer` says it for one
robot, `shared_sequencer` for several. Protocol and its argument: docs/design/state.md.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping

from fogft.core import lag, ordering
from fogft.core.ordered_log import Checkpoint, OrderedLog
from fogft.core.ordered_peer import RETRY_FIRST_S, Order, Peer, Phase
from fogft.core.ordering import START, Op, Position, Promise

CHECKPOINT_RETRY_S = 1.0
CHECK_EVERY_S = 1.0
WINDOW = 128


class OrderedTerm(ABC):
    """One term of a sequencer.

    Args:
        epoch: This term, above every earlier one.
        mark: The position of the last answer that was returned, in whatever term.
        log_entries: Requests kept at most.
        log_bytes: Their bytes at most.
    """

    def __init__(
        self,
        epoch: int,
        *,
        mark: Position = START,
        log_entries: int = 8192,
        log_bytes: int = 64 << 20,
    ) -> None:
        self.epoch = epoch
        self.mark = mark
        self.base: Position | None = None  # None until the term has begun
        self.log: OrderedLog | None = None
        self.deposed_by: int | None = None
        self.held_by = ""  # another robot whose order the replicas obey
        self._versions: Mapping[int, str] = {}
        self._leaving: frozenset[int] = frozenset()
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

    @abstractmethod
    def _lead(self, replica: int, peer: Peer) -> None:
        """Begin the term, if it may begin now that this replica was claimed."""

    @abstractmethod
    def _govern(self, now: float) -> None:
        """Do what else is due."""

    @abstractmethod
    def _applied(self, replica: int, index: int, payload: bytes) -> bool:
        """A replica says that it has applied a number. Return whether that answers it."""

    @abstractmethod
    def _recall(self, replica: int, before: int) -> None:
        """Ask a replica that has joined for answers that never came."""

    def _has_own_state(self, replica: int, at: Position) -> bool:
        """Whether a replica's state is one that this term knows."""
        return at.epoch == self.epoch or at == self.base

    def _read_promise(self, replica: int, payload: bytes) -> Promise:
        """Read what a claim was answered with. Raises OrderError."""
        return ordering.decode_promise(payload)

    def _read_joined(self, replica: int, payload: bytes) -> tuple[int, int]:
        """Return which number a replica expects, and which it has applied. Raises OrderError."""
        expected = ordering.decode_index(payload)
        return expected, expected - 1

    def _to_bring(self, replica: int, payload: bytes) -> bytes:
        """Return the bytes of an order that lets a replica join or restores it."""
        return payload

    def _wants_checkpoint(self, log: OrderedLog) -> bool:
        """Whether a checkpoint is needed though the log is not half full."""
        # A log that begins with the service's first state needs none; nor does one just taken.
        waits = any(p.phase is Phase.CLAIMED for p in self._peers.values())
        return waits or (log.checkpoint is None and log.start > 0)

    def _keep_checkpoint(self, index: int, state: bytes) -> None:
        assert self.log is not None
        self.log.keep(Checkpoint(index, state))

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

    @property
    def stranded(self) -> bool:
        """Whether replicas answer, and none of them can be brought to the present state."""
        phases = [peer.phase for peer in self._peers.values()]
        return Phase.CLAIMED in phases and Phase.ASKED not in phases and not self.ready

    def take(self) -> list[Order]:
        """Return the orders to send, in this order, and forget them."""
        out, self._out = self._out, []
        return out

    def reach(
        self,
        replicas: Iterable[int],
        now: float,
        *,
        versions: Mapping[int, str] | None = None,
        leaving: Iterable[int] = (),
    ) -> None:
        """Set which replicas can be sent to; new ones are claimed at once.

        Args:
            replicas: Them.
            now: In seconds.
            versions: What each runs; all the same unless told.
            leaving: Those that are to go soon.
        """
        wanted = set(replicas)
        self._versions, self._leaving = versions or {}, frozenset(leaving)
        for replica in [r for r in self._peers if r not in wanted]:
            self._drop(replica)
        for replica in sorted(wanted - self._peers.keys()):
            self._peers[replica] = Peer()
        self.tick(now)

    def _drop(self, replica: int) -> None:
        del self._peers[replica]
        if self._asked_for_checkpoint == replica:
            self._asked_for_checkpoint = None

    def _version(self, replica: int) -> str:
        return self._versions.get(replica, "")

    def tick(self, now: float) -> None:
        """Do what is due: claim again, send what is missing, ask for a checkpoint."""
        if self.deposed_by is not None:
            return
        for replica, peer in self._peers.items():
            if peer.phase is Phase.UNCLAIMED and peer.retry_at <= now:
                peer.phase = Phase.ASKED
                self._order(replica, Op.CLAIM)
            elif peer.phase is Phase.CLAIMED:
                self._bring(replica, peer)
                self._ask_again(replica, peer, now)
            elif peer.phase is Phase.JOINED:
                self._look_at_lag(peer, now)
                self._feed(replica, peer)
                self._check(replica, peer, now)
        self._govern(now)
        self._see_to_checkpoint(now)

    def _order(self, replica: int, op: Op, payload: bytes = b"") -> None:
        """Send an order that is about no number: it is told apart by a serial."""
        self._serial += 1
        self._out.append(Order(replica, op, self._serial, payload))

    def _begin_at(self, position: Position) -> None:
        entries, size = self._bounds
        self.base = position
        self.log = OrderedLog(position.index, entries_limit=entries, bytes_limit=size)

    def _ask_again(self, replica: int, peer: Peer, now: float) -> None:
        """Claim anew one that waits for long: it may have applied more since it was asked."""
        if peer.phase is not Phase.CLAIMED:
            return
        if peer.waits_since is None:
            peer.waits_since = now
        elif now - peer.waits_since > CHECK_EVERY_S and self._asked_for_checkpoint is None:
            peer.phase = Phase.ASKED
            self._order(replica, Op.CLAIM)

    def _check(self, replica: int, peer: Peer, now: float) -> None:
        """Ask an idle replica where it stands: no request would tell that its service died."""
        if peer.phase is Phase.JOINED and not peer.open and now - peer.checked_at > CHECK_EVERY_S:
            peer.checked_at = now
            self._order(replica, Op.CLAIM)

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

    # -- numbers --------------------------------------------------------------------------

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

    # -- what replicas say ----------------------------------------------------------------

    def replied(self, replica: int, op: Op, index: int, payload: bytes) -> bool:
        """Take a reply. Return whether it is the answer to a number: return it, after having
        written down `mark`.

        Raises:
            OrderError: The bytes are not what this operation is answered with.
        """
        peer = self._peers.get(replica)
        if op in (Op.APPLY, Op.RECALL):
            answers = self._applied(replica, index, payload)
            if peer is not None:
                peer.open.discard(index)
                peer.acked = max(peer.acked, index)
                peer.won += answers
                if peer.phase is Phase.JOINED:
                    self._feed(replica, peer)
            return answers
        if op is Op.SNAPSHOT:
            if self._asked_for_checkpoint == replica:
                self._asked_for_checkpoint = None
            self._take_checkpoint(*ordering.decode_snapshot(payload))
        elif peer is not None and op is Op.CLAIM:
            self._promised(replica, peer, self._read_promise(replica, payload))
        elif peer is not None and op in (Op.JOIN, Op.RESTORE):
            self._has_joined(replica, peer, *self._read_joined(replica, payload))
        return False

    def _promised(self, replica: int, peer: Peer, promise: Promise) -> None:
        if promise.position.epoch != self.epoch:
            peer.member = False
            if peer.phase is Phase.JOINED:
                peer.phase = Phase.UNCLAIMED
        if peer.phase is not Phase.ASKED:
            return
        peer.phase = Phase.CLAIMED
        peer.promise, peer.waits_since = promise, None
        self.held_by = ""
        if self.base is not None:
            self._bring(replica, peer)
        else:
            self._lead(replica, peer)

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
            payload = self._to_bring(replica, ordering.encode_join(at, log.last))
            self._out.append(Order(replica, Op.JOIN, at.index, payload))
        elif kept is not None:
            peer.phase = Phase.ASKED
            payload = self._to_bring(replica, ordering.encode_snapshot(log.last, kept.state))
            self._out.append(Order(replica, Op.RESTORE, kept.index, payload))

    def _bring_all(self, *, waited: bool = False) -> None:
        for replica, peer in self._peers.items():
            if peer.phase is Phase.CLAIMED:
                self._bring(replica, peer, waited=waited)

    def _has_joined(self, replica: int, peer: Peer, expected: int, applied: int) -> None:
        log = self.log
        if peer.phase is not Phase.ASKED or log is None:
            return
        if not log.covers(expected - 1):  # the log has moved on meanwhile
            peer.phase = Phase.UNCLAIMED
            return
        peer.phase = Phase.JOINED
        peer.member = True
        peer.wait_s = RETRY_FIRST_S / 2
        peer.rewind = None
        peer.next = expected
        peer.acked = applied
        # Applied there, and the answer never came: it is kept, and is asked for again.
        self._recall(replica, expected)
        self._feed(replica, peer)

    # -- what does not succeed ------------------------------------------------------------

    def refused(self, replica: int, op: Op, index: int, reason: str, now: float) -> None:
        """Take a refusal, or the loss of an order: the replica may or may not have obeyed it."""
        epoch = ordering.read_fenced(reason)
        if epoch is not None and epoch > self.epoch:
            self.deposed_by = max(epoch, self.deposed_by or 0)
            self._out.clear()
            return
        self.held_by = ordering.read_held(reason) or self.held_by
        peer = self._peers.get(replica)
        if op is Op.SNAPSHOT:
            if self._asked_for_checkpoint == replica:
                self._asked_for_checkpoint = None
            self._bring_all(waited=True)
            return
        if peer is None:
            return
        if op in (Op.APPLY, Op.RECALL):
            peer.open.discard(index)
            if reason in (ordering.FORGOTTEN, ordering.MALFORMED):
                peer.acked = max(peer.acked, index)
                return
            expected = ordering.read_gap(reason)
            if expected is not None:
                peer.go_back(expected)
                return
        peer.pause(now)

    def declined(self, replica: int, op: Op, index: int, now: float) -> None:
        """An order was not taken by the link: it was not sent."""
        peer = self._peers.get(replica)
        if op is Op.SNAPSHOT:
            if self._asked_for_checkpoint == replica:
                self._asked_for_checkpoint = None
        elif peer is None:
            return
        elif op is Op.APPLY:
            peer.open.discard(index)
            peer.go_back(index)
        else:
            peer.open.discard(index)
            peer.pause(now)

    # -- the log's bounds -----------------------------------------------------------------

    def _see_to_checkpoint(self, now: float) -> None:
        log = self.log
        if log is None or self._asked_for_checkpoint is not None or now < self._checkpoint_at:
            return
        if not self._wants_checkpoint(log) and not log.half_full:
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
