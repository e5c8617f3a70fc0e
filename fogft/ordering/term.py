"""One term of a sequencer: claim replicas, let them join, take what they say. Pure.

A term claims the replicas, begins from the state of one of them, and from then on appends
requests to its log. The owner sends what `take` returns, and reports each order's end, once, by
`replied`, `refused` or `declined`.

Owns: how far each replica obeys. Not here: what each is to be sent (`catching_up`), from what a
term may begin and when an answer counts (`sequencer`).
Protocol and its argument: docs/design/state.md.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping

from fogft.model.refusal import Refusal
from fogft.ordering import orders
from fogft.ordering.catching_up import CatchingUp
from fogft.ordering.orders import START, Op, Position, Promise
from fogft.ordering.peer import RETRY_FIRST_S, Peer, Phase

CHECK_EVERY_S = 1.0


class OrderedTerm(CatchingUp):
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
        super().__init__(epoch, log_entries=log_entries, log_bytes=log_bytes)
        self.mark = mark
        self.held_by = ""  # another robot whose order the replicas obey
        self._versions: Mapping[int, str] = {}
        self._leaving: frozenset[int] = frozenset()

    # -- what differs ---------------------------------------------------------------------

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

    # -- what the owner asks --------------------------------------------------------------

    @property
    def stranded(self) -> bool:
        """Whether replicas answer, and none of them can be brought to the present state."""
        phases = [peer.phase for peer in self._peers.values()]
        return Phase.CLAIMED in phases and Phase.ASKED not in phases and not self.ready

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
            self._take_checkpoint(*orders.decode_snapshot(payload))
        elif peer is not None and op is Op.CLAIM:
            self._promised(replica, peer, orders.decode_promise(payload))
        elif peer is not None and op in (Op.JOIN, Op.RESTORE):
            self._has_joined(replica, peer, orders.decode_index(payload))
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

    def _has_joined(self, replica: int, peer: Peer, expected: int) -> None:
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
        self._recall(replica, expected)
        self._feed(replica, peer)

    # -- what does not succeed ------------------------------------------------------------

    def refused(
        self, replica: int, op: Op, index: int, reason: Refusal, now: float, *, detail: str = ""
    ) -> None:
        """Take a refusal, or the loss of an order: the replica may or may not have obeyed it."""
        epoch = orders.read_epoch(detail) if reason is Refusal.FENCED else None
        if epoch is not None and epoch > self.epoch:
            self.deposed_by = max(epoch, self.deposed_by or 0)
            self._out.clear()
            return
        if reason is Refusal.HELD:
            self.held_by = detail
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
            if reason in (Refusal.FORGOTTEN, Refusal.MALFORMED):
                peer.acked = max(peer.acked, index)
                return
            expected = orders.read_index(detail) if reason is Refusal.GAP else None
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
