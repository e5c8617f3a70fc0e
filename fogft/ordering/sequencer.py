"""One term of a stateful service: claim replicas, make them join, take their answers. Pure.

A term begins from the state of one replica, never one before the mark. From then on it numbers
requests, and the first answer counts. When more of the replicas that stay run another version, that
takes over at one point in the order. The owner sends the orders from `take` and reports the end of
each, once, by `replied`, `refused` or `declined`. Protocol and rationale: docs/design/state.md.
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from fogft.model.refusal import Refusal
from fogft.ordering import orders
from fogft.ordering.active_version import ActiveVersion
from fogft.ordering.catching_up import CatchingUp
from fogft.ordering.orders import START, Op, OrderError, Position, Promise
from fogft.ordering.peer import RETRY_LIMIT_S, Peer, Phase

CHECK_EVERY_S = 1.0
_GOES_BACK = 8  # times without an acknowledged number: orders may overtake each other


class Handover(NamedTuple):
    """The start of a term with another active version, once all earlier requests are applied."""

    version: str  # the version that becomes active
    at: Position  # the state that it takes over
    state: bytes


class Sequencer:
    """One term of a sequencer, numbered `epoch`, which exceeds every earlier one.

    `mark` is the position of the last answer that was returned, in any term, and `holder` the
    version that returned it, None if unknown. With `begin`, another version takes over.
    """

    def __init__(
        self,
        epoch: int,
        *,
        mark: Position = START,
        holder: str | None = None,
        begin: Handover | None = None,
    ) -> None:
        self.epoch = epoch
        self.mark = mark
        self.active = ActiveVersion(begin.version if begin else holder)
        self.deposed_by: int | None = None  # a later term that more replicas obey
        self._fenced: dict[int, int] = {}  # replica -> the later term that it says it obeys
        self.held_by = ""  # another robot, whose orders replicas obey
        self.handover: Handover | None = None  # ends this term: the next one begins from it
        self._versions: Mapping[int, str] = {}
        self._draining: frozenset[int] = frozenset()
        self._change_to: str | None = None  # the next version; no numbers are assigned meanwhile
        self._unanswered: dict[int, None] = {}
        # Number -> replica -> how often its service died over it; 0 if it may have applied it.
        self._deaths: dict[int, dict[int, int]] = {}
        self._applied_to = 0  # by any replica: no request up to this number may be emptied
        self._replicas = CatchingUp(epoch, self._counts, handed_over=begin is not None)
        self._peers = self._replicas.peers
        self.log = self._replicas.log  # the numbered requests; empty until the term has begun
        self.take = self._replicas.take  # removes and returns the orders to send, in order
        if begin is not None:
            self._replicas.begin_at(begin.at)
            self._replicas.take_checkpoint(begin.at.index, begin.state)

    # -- called by the owner --------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Whether a request numbered now is sent at once to a replica whose answer counts."""
        return self._replicas.ready

    @property
    def joined(self) -> list[int]:
        """The replicas that apply requests."""
        return [replica for replica, peer in self._peers.items() if peer.joined]

    @property
    def stranded(self) -> bool:
        """Whether replicas answer, but none of them can reach the current state."""
        phases = [peer.phase for peer in self._peers.values()]
        return Phase.CLAIMED in phases and Phase.ASKED not in phases and not self.ready

    @property
    def due(self) -> bool:
        """Whether the owner must act at once: send orders, or end the term."""
        ends = self.deposed_by is not None or self.handover is not None
        return ends or bool(self._replicas.out) or self._change_to is not None

    def submit(self, payload: bytes) -> int | None:
        """Number a request and order it applied; None if the term is not running or is full."""
        if self._change_to is not None or self.deposed_by is not None:
            return None
        index = self._replicas.append(payload)
        if index is not None:
            self._unanswered[index] = None
        return index

    def abandon(self, index: int) -> None:
        """Note that nobody awaits this number's answer any more. It is still applied."""
        self._unanswered.pop(index, None)

    def reach(
        self,
        replicas: Iterable[int],
        now: float,
        *,
        versions: Mapping[int, str] | None = None,
        draining: Iterable[int] = (),
    ) -> None:
        """Set the reachable replicas and their versions; new ones are claimed."""
        wanted = set(replicas)
        self._versions, self._draining = versions or {}, frozenset(draining)
        for replica in [r for r in self._peers if r not in wanted]:
            for index in self._peers.pop(replica).open:  # it may still apply them
                self._deaths.setdefault(index, {})[replica] = 0
            self._fenced.pop(replica, None)
            self._gave_no_checkpoint(replica)
        for replica in sorted(wanted - self._peers.keys()):
            self._peers[replica] = Peer()
        self.tick(now)

    def _version(self, replica: int) -> str:
        return self._versions.get(replica, "")

    def _counts(self, replica: int) -> bool:
        return self._version(replica) == self.active.version

    def _gave_no_checkpoint(self, replica: int) -> None:
        if self._replicas.donor == replica:
            self._replicas.donor = None

    def tick(self, now: float) -> None:
        """Do what is due: claim again, send missing requests, request a checkpoint."""
        self._look_whom_most_obey()
        if self.deposed_by is not None:
            return
        for replica, peer in self._peers.items():
            if peer.phase is Phase.UNCLAIMED and peer.retry_at <= now:
                if not self._waits_for_others(replica):
                    self._claim(replica, peer)
            elif peer.phase is Phase.CLAIMED:
                self._replicas.bring(replica, peer)
                self._claim_again(replica, peer, now)
            elif peer.joined:
                self._replicas.look_at_lag(peer, now)
                self._replicas.feed(replica, peer)
                self._check(replica, peer, now)
        self._govern(now)
        self._replicas.see_to_checkpoint(now)

    def _claim(self, replica: int, peer: Peer) -> None:
        peer.phase = Phase.ASKED
        self._replicas.order(replica, Op.CLAIM)

    def _waits_for_others(self, replica: int) -> bool:
        """Whether it and others died over a request that one works on again: await its outcome."""
        over = [n for n, d in self._deaths.items() if 0 < d.get(replica, 0) < sum(d.values())]
        return any(n in one.open for n in over for one in self._peers.values())

    def _claim_again(self, replica: int, peer: Peer, now: float) -> None:
        """Claim a replica again that has waited long: it may have applied more since its claim."""
        if peer.phase is not Phase.CLAIMED:
            return
        if peer.waits_since is None:
            peer.waits_since = now
        elif now - peer.waits_since > CHECK_EVERY_S and self._replicas.donor is None:
            self._claim(replica, peer)

    def _check(self, replica: int, peer: Peer, now: float) -> None:
        """Ask an idle replica for its position: no request would reveal that its service died."""
        if peer.joined and not peer.open and now - peer.checked_at > CHECK_EVERY_S:
            peer.checked_at = now
            self._replicas.order(replica, Op.CLAIM)

    # -- replies from replicas ------------------------------------------------------------

    def replied(self, replica: int, op: Op, index: int, payload: bytes) -> bool:
        """Take a reply; True if it answers a number: store `mark` before passing the answer on.

        Raises OrderError: the payload is not a valid answer to this operation.
        """
        peer = self._peers.get(replica)
        if op in (Op.APPLY, Op.RECALL):
            answers = self._applied(replica, index)
            if peer is not None:
                peer.open.discard(index)
                peer.acked, peer.went_back = max(peer.acked, index), 0
                peer.won += answers
                if peer.joined:
                    self._replicas.feed(replica, peer)
            return answers
        if op is Op.SNAPSHOT:
            self._gave_no_checkpoint(replica)
            self._take_checkpoint(*orders.decode_snapshot(payload))
        elif peer is not None and op is Op.CLAIM:
            self._promised(replica, peer, orders.decode_promise(payload))
        elif peer is not None and op in (Op.JOIN, Op.RESTORE):
            self._has_joined(replica, peer, orders.decode_index(payload))
        return False

    def _applied(self, replica: int, index: int) -> bool:
        """Note that a replica applied a number; return whether its reply is the answer to it."""
        self._applied_to = max(self._applied_to, index)
        for known in [n for n in self._deaths if n <= self._applied_to]:
            del self._deaths[known]
        first = index in self._unanswered and self._counts(replica)
        if first:
            del self._unanswered[index]
            # An answer to a later number implies all earlier ones; a mark never goes back.
            self.mark = max(self.mark, Position(self.epoch, index))
        return first

    def _take_checkpoint(self, index: int, state: bytes) -> None:
        if self.deposed_by is not None:
            return
        self._replicas.take_checkpoint(index, state)
        if self._change_to is not None and index == self.log.last and not self._unanswered:
            self.handover = Handover(self._change_to, Position(self.epoch, index), state)

    def _promised(self, replica: int, peer: Peer, promise: Promise) -> None:
        if promise.position.epoch > self.epoch:
            raise OrderError(f"a promise in the later term {promise.position.epoch:x}")
        self._fenced.pop(replica, None)
        if promise.position.epoch != self.epoch:
            peer.member = False
            if peer.joined:
                peer.phase = Phase.UNCLAIMED
        if peer.phase is not Phase.ASKED:
            return
        peer.phase = Phase.CLAIMED
        peer.promise, peer.waits_since = promise, None
        self.held_by = ""
        if self._replicas.base is not None:
            self._replicas.bring(replica, peer)
        else:
            self._lead(replica, promise)

    def _lead(self, replica: int, promise: Promise) -> None:
        """Begin the term from the state of a claimed replica, if that is allowed."""
        if not promise.sound or promise.position < self.mark:
            return
        if self.active.may_lead(self._version(replica)):
            self.active.version = self._version(replica)
            self._replicas.begin_at(promise.position)
            self._replicas.bring_all()

    def _has_joined(self, replica: int, peer: Peer, expected: int) -> None:
        if peer.phase is not Phase.ASKED:
            return
        if not self.log.covers(expected - 1):  # the log has moved on meanwhile
            peer.phase = Phase.UNCLAIMED
            return
        peer.join(expected)
        self._recall(replica, expected)
        self._replicas.feed(replica, peer)

    def _recall(self, replica: int, before: int) -> None:
        """Ask a replica for answers that never came: it has applied those requests."""
        for index in self._unanswered:
            if index < before:
                self._replicas.recall(replica, index)

    # -- failed orders --------------------------------------------------------------------

    def refused(
        self, replica: int, op: Op, index: int, reason: Refusal, now: float, *, detail: str = ""
    ) -> bool:
        """Take the refusal or loss of an order, which the replica may have executed.

        Return whether every service has died over this number: it is now applied without effect.
        """
        epoch = orders.read_epoch(detail) if reason is Refusal.FENCED else None
        if epoch is not None and epoch > self.epoch:
            self._fenced[replica] = epoch
        if reason is Refusal.HELD:
            self.held_by = detail
        peer = self._peers.get(replica)
        if op is Op.SNAPSHOT:
            self._gave_no_checkpoint(replica)
            self._replicas.bring_all(waited=True)
        if op is Op.APPLY and reason is Refusal.LOST and self._applied_to < index:
            self._deaths.setdefault(index, {})[replica] = 0
        if peer is None or op is Op.SNAPSHOT:
            return False
        kills = op is Op.APPLY and reason is Refusal.CRASHED and self._kills(replica, peer, index)
        if op in (Op.APPLY, Op.RECALL):
            peer.open.discard(index)
            if reason in (Refusal.FORGOTTEN, Refusal.MALFORMED):
                peer.acked = max(peer.acked, index)
                self._applied_to = max(self._applied_to, index)
                return False
            expected = orders.read_index(detail) if reason is Refusal.GAP else None
            if expected is not None and not (peer.joined and peer.went_back >= _GOES_BACK):
                peer.went_back += peer.joined and not peer.rewind
                peer.go_back(expected)
                return False
            if expected is not None:
                peer.wait_s = RETRY_LIMIT_S  # it may do so for every order
        peer.pause(now)
        self._look_whom_most_obey()
        return kills

    def _kills(self, replica: int, peer: Peer, index: int) -> bool:
        """Empty a request over which every service has died, twice at least; return whether."""
        if index != peer.acked + 1 or index <= max(self.log.start, self._applied_to):
            return False
        deaths = self._deaths.setdefault(index, {})
        deaths[replica] = deaths.get(replica, 0) + 1
        if not all(deaths.values()) or sum(deaths.values()) < 2 or self._peers.keys() - deaths:
            return False
        if any(index in other.open for other in self._peers.values() if other is not peer):
            return False  # another replica is working on it
        self.log.empty(index)
        return True

    def _look_whom_most_obey(self) -> None:
        """End the term if more replicas obey a later one, or as many before it has begun."""
        others = [peer for replica, peer in self._peers.items() if replica not in self._fenced]
        silent = any(one.phase is Phase.ASKED and one.promise is None for one in others)
        if not self._fenced or silent:
            return
        obey = sum(one.promise is not None and one.phase is not Phase.UNCLAIMED for one in others)
        if len(self._fenced) > obey or (len(self._fenced) == obey and self._replicas.base is None):
            self.deposed_by = max(self._fenced.values())
            self._replicas.take()

    def declined(self, replica: int, op: Op, index: int, now: float) -> None:
        """Note that the link did not accept an order, so it was not sent."""
        peer = self._peers.get(replica)
        if op is Op.SNAPSHOT:
            self._gave_no_checkpoint(replica)
        elif peer is not None:
            peer.open.discard(index)
            if op is Op.APPLY:
                peer.go_back(index)
            else:
                peer.pause(now)

    # -- versions -------------------------------------------------------------------------

    def _govern(self, now: float) -> None:
        """Let a version take over: by a handover, or because the active one is gone."""
        joined = self.joined
        standing = [self._version(r) for r in joined]
        self.active.look(standing, now)
        if self._replicas.base is None:
            for replica, peer in self._peers.items():
                if self._replicas.base is None and peer.phase is Phase.CLAIMED and peer.promise:
                    self._lead(replica, peer.promise)
        elif (heir := self.active.successor(standing)) is not None:
            self.active.version = heir
            self._change_to = None
            for replica in joined:
                if self._counts(replica):
                    self._recall(replica, self._peers[replica].next)
        elif self.handover is None:
            staying = [self._version(r) for r in joined if r not in self._draining]
            self._change_to = self.active.wanted(staying)
            self._prepare_handover(now)

    def _prepare_handover(self, now: float) -> None:
        """Request a snapshot after the last number, once all requests have been answered."""
        if self._change_to is None or self._unanswered:
            return
        donors = [
            (r in self._draining, p.won, r)
            for r, p in self._peers.items()
            if p.joined and self._counts(r) and p.acked >= self.log.last and not p.open
        ]
        self._replicas.ask_for_checkpoint(donors, now)
