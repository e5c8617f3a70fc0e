"""Number the requests of a stateful service and bring every replica through them. Pure.

One `Sequencer` is one term: it claims the replicas, begins from the state of one of them
(never from one before the mark), and from then on gives out numbers. It holds what each
replica still needs. What is to be sent collects until `take`; the owner sends it and
reports each order's end, once, by `replied`, `refused` or `declined`.

Owns: one term's numbers, its log, and what each replica is to be sent.
Not here: callers and deadlines (`fogft.proxy.ordered_dispatcher`), bytes on the wire.
Protocol and its argument: docs/design/state.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum

from fogft.core import lag, ordering
from fogft.core.office import Office
from fogft.core.ordered_log import Checkpoint, OrderedLog
from fogft.core.ordering import START, Op, Position, Promise

RETRY_FIRST_S = 0.02
RETRY_LIMIT_S = 0.5
CHECKPOINT_RETRY_S = 1.0
CHECK_EVERY_S = 1.0
WINDOW = 128


@dataclass(frozen=True)
class Order:
    """What to send to a replica: an operation of this term, with its bytes."""

    replica: int
    op: Op
    index: int
    payload: bytes = b""


class Phase(Enum):
    """How far a replica has come in this term."""

    UNCLAIMED = "unclaimed"  # it is to be claimed, at once or after a pause
    ASKED = "asked"  # an order is on its way that changes its phase
    CLAIMED = "claimed"  # it obeys, and waits for a state that it can take
    JOINED = "joined"  # it applies what is sent to it


@dataclass
class _Peer:
    """A replica as this term knows it."""

    phase: Phase = Phase.UNCLAIMED
    promise: Promise | None = None
    next: int = 0  # the number to send next
    rewind: int | None = None  # go back to it once nothing is on its way
    open: set[int] = field(default_factory=set)
    acked: int = 0
    member: bool = False  # it joined this term, and as far as is known its state is still there
    won: int = 0
    wait_s: float = RETRY_FIRST_S / 2
    retry_at: float = 0.0
    checked_at: float = 0.0
    waits_since: float | None = None
    lag: lag.Lag = field(default_factory=lag.Lag)
    lags: bool = False  # it is sent no more: a snapshot takes it further


@dataclass(frozen=True)
class Handover:
    """From what a term begins in which another version takes office.

    Attributes:
        version: The one that takes it.
        at: The state that it takes over: every number given before has been applied there.
        state: Its bytes.
    """

    version: str
    at: Position
    state: bytes


class Sequencer:
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
        self.epoch = epoch
        self.mark = mark
        self.base: Position | None = None  # None until the term has begun
        self.log: OrderedLog | None = None
        self.office = Office(begin.version if begin else holder)
        self.handover: Handover | None = None  # this term's end: the next begins from it
        self._begin = begin
        self._change_to: str | None = None  # no number is given meanwhile
        self._versions: Mapping[int, str] = {}
        self._leaving: frozenset[int] = frozenset()
        self.deposed_by: int | None = None
        self.held_by = ""  # another robot whose order the replicas obey
        self._bounds = (log_entries, log_bytes)
        if begin is not None:
            self._begin_at(begin.at)
            self._take_checkpoint_of(begin)
        self._peers: dict[int, _Peer] = {}
        self._out: list[Order] = []
        self._unanswered: dict[int, None] = {}
        self._serial = 0
        self._asked_for_checkpoint: int | None = None
        self._checkpoint_at = 0.0

    # -- what the owner asks --------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Whether a number given now is sent at once to somebody whose answer counts."""
        return any(
            peer.phase is Phase.JOINED and self._counts(replica)
            for replica, peer in self._peers.items()
        )

    def _version(self, replica: int) -> str:
        return self._versions.get(replica, "")

    def _counts(self, replica: int) -> bool:
        return self.office.believes(self._version(replica))

    @property
    def sends(self) -> bool:
        """Whether `take` has something to send."""
        return bool(self._out)

    @property
    def joined(self) -> list[int]:
        """The replicas that apply what is sent to them."""
        return [replica for replica, peer in self._peers.items() if peer.phase is Phase.JOINED]

    @property
    def changing(self) -> bool:
        """Whether another version is to take over as soon as all is answered."""
        return self._change_to is not None

    @property
    def stranded(self) -> bool:
        """Whether replicas answer, and none of them can be brought to the present state."""
        waiting = [p for p in self._peers.values() if p.phase is Phase.CLAIMED]
        return bool(waiting) and not self.ready and not self._coming()

    def _coming(self) -> bool:
        return any(peer.phase is Phase.ASKED for peer in self._peers.values())

    def take(self) -> list[Order]:
        """Return the orders to send, in this order, and forget them."""
        out, self._out = self._out, []
        return out

    def submit(self, payload: bytes) -> int | None:
        """Number a request and order it applied; None while the term has not begun or is full."""
        log = self.log
        if log is None or self.deposed_by is not None or self._change_to is not None:
            return None
        if not log.has_room(len(payload)) and not self._make_room(len(payload)):
            return None
        index = log.append(payload)
        self._unanswered[index] = None
        for replica, peer in self._peers.items():
            if peer.phase is not Phase.JOINED:
                continue
            if peer.next == index and peer.rewind is None and len(peer.open) < WINDOW:
                peer.next = index + 1
                peer.open.add(index)
                self._out.append(Order(replica, Op.APPLY, index, payload))
        return index

    def abandon(self, index: int) -> None:
        """Nobody waits for the answer to this number any more. It is applied all the same."""
        self._unanswered.pop(index, None)

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
            self._peers[replica] = _Peer()
        self.tick(now)

    def _drop(self, replica: int) -> None:
        del self._peers[replica]
        if self._asked_for_checkpoint == replica:
            self._asked_for_checkpoint = None

    def tick(self, now: float) -> None:
        """Do what is due: claim again, send what is missing, ask for a checkpoint."""
        if self.deposed_by is not None:
            return
        for replica, peer in self._peers.items():
            if peer.phase is Phase.UNCLAIMED and peer.retry_at <= now:
                peer.phase = Phase.ASKED
                self._serial += 1
                self._out.append(Order(replica, Op.CLAIM, self._serial))
            elif peer.phase is Phase.CLAIMED:
                self._bring(replica, peer)
                self._ask_again(replica, peer, now)
            elif peer.phase is Phase.JOINED:
                self._look_at_lag(peer, now)
                self._feed(replica, peer)
                self._check(replica, peer, now)
        self._see_to_office(now)
        self._see_to_checkpoint(now)

    def _look_at_lag(self, peer: _Peer, now: float) -> None:
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

    def _keeps_up(self, peer: _Peer) -> bool:
        log = self.log
        return peer.phase is Phase.JOINED and log is not None and log.last - peer.acked <= WINDOW

    # -- versions -------------------------------------------------------------------------

    def _see_to_office(self, now: float) -> None:
        """Have a version take over: by a handover, or because nobody is left in office."""
        joined = self.joined
        standing = [self._version(r) for r in joined]
        self.office.look(standing, now)
        if self.base is None:
            self._find_base()
        elif (heir := self.office.successor(standing)) is not None:
            self.office.holder = heir
            self._change_to = None
            for replica in joined:
                if self._counts(replica):
                    self._recall(replica, self._peers[replica], self._peers[replica].next)
        elif self.handover is None:
            staying = [self._version(r) for r in joined if r not in self._leaving]
            self._change_to = self.office.wish(staying)
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

    def _find_base(self) -> None:
        for replica, peer in self._peers.items():
            if self.base is None and peer.phase is Phase.CLAIMED:
                self._lead(replica, peer)

    def _lead(self, replica: int, peer: _Peer) -> bool:
        """Begin the term from the state of a replica, if it may be."""
        promise = peer.promise
        if promise is None or not promise.sound or promise.position < self.mark:
            return False
        if not self.office.may_lead(self._version(replica)):
            return False
        self.office.holder = self._version(replica)
        self._begin_at(promise.position)
        for other, known in self._peers.items():
            if known.phase is Phase.CLAIMED:
                self._bring(other, known)
        return True

    def _begin_at(self, position: Position) -> None:
        entries, size = self._bounds
        self.base = position
        self.log = OrderedLog(position.index, entries_limit=entries, bytes_limit=size)

    def _take_checkpoint_of(self, begin: Handover) -> None:
        assert self.log is not None
        self.log.keep(Checkpoint(begin.at.index, begin.state))

    def _has_own_state(self, replica: int, at: Position) -> bool:
        """Whether a replica's state is one that this term knows, and not one it stood by with."""
        if at.epoch == self.epoch:
            return True
        if self._begin is not None and self._counts(replica):
            return False  # of the version that took over: it begins from what was handed over
        return at == self.base

    def _ask_again(self, replica: int, peer: _Peer, now: float) -> None:
        """Claim anew one that waits for long: it may have applied more since it was asked."""
        if peer.phase is not Phase.CLAIMED:
            return
        if peer.waits_since is None:
            peer.waits_since = now
        elif now - peer.waits_since > CHECK_EVERY_S and self._asked_for_checkpoint is None:
            peer.phase = Phase.ASKED
            self._serial += 1
            self._out.append(Order(replica, Op.CLAIM, self._serial))

    def _check(self, replica: int, peer: _Peer, now: float) -> None:
        """Ask an idle replica where it stands: no request would tell that its service died."""
        if peer.phase is Phase.JOINED and not peer.open and now - peer.checked_at > CHECK_EVERY_S:
            peer.checked_at = now
            self._serial += 1
            self._out.append(Order(replica, Op.CLAIM, self._serial))

    # -- what replicas say ----------------------------------------------------------------

    def replied(self, replica: int, op: Op, index: int, payload: bytes) -> bool:
        """Take a reply. Return whether it is the first answer to a number: return it, after
        having written down `mark`.

        Raises:
            OrderError: The bytes are not what this operation is answered with.
        """
        peer = self._peers.get(replica)
        if op in (Op.APPLY, Op.RECALL):
            return self._applied(peer, replica, index)
        if op is Op.SNAPSHOT:
            if self._asked_for_checkpoint == replica:
                self._asked_for_checkpoint = None
            self._take_checkpoint(*ordering.decode_snapshot(payload))
            return False
        if peer is None:
            return False
        if op is Op.CLAIM:
            self._promised(replica, peer, ordering.decode_promise(payload))
        else:
            self._has_joined(replica, peer, ordering.decode_index(payload))
        return False

    def _applied(self, peer: _Peer | None, replica: int, index: int) -> bool:
        first = index in self._unanswered and self._counts(replica)
        if first:
            del self._unanswered[index]
            # Answers to later numbers imply all earlier ones; a mark never goes back.
            self.mark = max(self.mark, Position(self.epoch, index))
        if peer is not None:
            peer.open.discard(index)
            peer.acked = max(peer.acked, index)
            peer.won += first
            if peer.phase is Phase.JOINED:
                self._feed(replica, peer)
        return first

    def _promised(self, replica: int, peer: _Peer, promise: Promise) -> None:
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

    def _bring(self, replica: int, peer: _Peer, *, waited: bool = False) -> None:
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
            payload = ordering.encode_join(at, log.last)
            self._out.append(Order(replica, Op.JOIN, at.index, payload))
        elif kept is not None:
            peer.phase = Phase.ASKED
            payload = ordering.encode_snapshot(log.last, kept.state)
            self._out.append(Order(replica, Op.RESTORE, kept.index, payload))

    def _bring_those_who_waited(self) -> None:
        for replica, peer in self._peers.items():
            if peer.phase is Phase.CLAIMED:
                self._bring(replica, peer, waited=True)

    def _has_joined(self, replica: int, peer: _Peer, expected: int) -> None:
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
        peer.acked = expected - 1
        # Applied there, and the answer never came: it is kept, and is asked for again.
        self._recall(replica, peer, expected)
        self._feed(replica, peer)

    def _recall(self, replica: int, peer: _Peer, before: int) -> None:
        for index in self._unanswered:
            if index < before and index not in peer.open:
                peer.open.add(index)
                self._out.append(Order(replica, Op.RECALL, index))

    def _feed(self, replica: int, peer: _Peer) -> None:
        log = self.log
        assert log is not None
        if peer.phase is not Phase.JOINED or peer.lags:
            return
        if peer.rewind is not None:
            if peer.open:
                return
            peer.next, peer.rewind = peer.rewind, None
        if not log.covers(peer.next - 1):
            self._pause(peer, 0.0)
            return
        while peer.next <= log.last and len(peer.open) < WINDOW:
            index = peer.next
            peer.next += 1
            if index not in peer.open:
                peer.open.add(index)
                self._out.append(Order(replica, Op.APPLY, index, log.get(index)))

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
            self._bring_those_who_waited()
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
                self._go_back(peer, expected)
                return
        self._pause(peer, now)

    def _go_back(self, peer: _Peer, expected: int) -> None:
        """Send again from a number, once what is on its way has been answered."""
        if peer.phase is Phase.JOINED and expected <= peer.next:
            peer.rewind = expected if peer.rewind is None else min(peer.rewind, expected)

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
            self._go_back(peer, index)
        else:
            peer.open.discard(index)
            self._pause(peer, now)

    def _pause(self, peer: _Peer, now: float) -> None:
        """Claim a replica anew after a moment, longer each time: that tells where it stands."""
        if peer.phase is Phase.UNCLAIMED:
            return
        peer.phase = Phase.UNCLAIMED
        peer.rewind = None
        peer.wait_s = min(peer.wait_s * 2, RETRY_LIMIT_S)
        peer.retry_at = now + peer.wait_s

    # -- the log's bounds -----------------------------------------------------------------

    def _see_to_checkpoint(self, now: float) -> None:
        log = self.log
        if log is None or self._asked_for_checkpoint is not None or now < self._checkpoint_at:
            return
        kept = log.checkpoint
        # A log that begins with the service's first state needs none; nor does one just taken.
        waits = any(p.phase is Phase.CLAIMED for p in self._peers.values())
        needed = waits or (kept is None and log.start > 0)
        if not needed and not log.half_full:
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
        self._serial += 1
        self._out.append(Order(replica, Op.SNAPSHOT, self._serial))

    def _take_checkpoint(self, index: int, state: bytes) -> None:
        if self.log is not None and self.deposed_by is None:
            self.log.keep(Checkpoint(index, state))
            if self._change_to is not None and index == self.log.last and not self._unanswered:
                self.handover = Handover(self._change_to, Position(self.epoch, index), state)
            self._checkpoint_at = 0.0
            self._bring_those_who_waited()

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
