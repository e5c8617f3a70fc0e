"""A term of one of several robots that share a stateful service: a majority counts. Pure.

It begins once a majority of the members obeys it, from the furthest state among them, and an
answer is returned once a majority of the members has applied its request: so whoever comes next
begins from a state that has it. Who the members are is itself part of the order, and changes by
one at a time.

Owns: from what a term begins, what is committed, who the members are, and what robots handed in.
Not here: numbers and how replicas come to them (`ordered_term`), when to claim (`shared_robot`).
Protocol and its argument: docs/design/state.md, "Several robots".
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from fogft.core import shared_orders
from fogft.core.majority import is_majority
from fogft.core.shared_orders import Entry, Handed, RequestId, Vote
from fogft.ordering import orders
from fogft.ordering.orders import START, Op, Position, Promise
from fogft.ordering.peer import Peer, Phase
from fogft.ordering.term import OrderedTerm

HEARTBEAT_S = 0.25
GONE_AFTER_S = 5.0
_LISTENS_LIMIT = 4  # heartbeats that a replica has not answered; no more are sent


@dataclass(frozen=True)
class Answered:
    """The answer to a request of the sequencer's own robot: it will last."""

    seq: int
    at: Position
    answer: bytes


@dataclass
class _Listen:
    """What was sent to a replica to have it tell what robots handed in."""

    sent_at: float = -1e9
    told: int = -1
    open: int = 0
    again: bool = True  # what it told may have been lost: it is to tell all of it again


class SharedSequencer(OrderedTerm):
    """One term of a shared sequencer.

    Args:
        epoch: This term, above every earlier one.
        mark: The position of the last answer that this robot returned.
        founders: With so many replicas a service may begin that never began; of more members
            than these, one that is gone is let go.
        may_found: Whether, as far as this robot knows, the service never began.
        log_entries: Requests kept at most.
        log_bytes: Their bytes at most.
    """

    def __init__(
        self,
        epoch: int,
        *,
        mark: Position = START,
        founders: int = 3,
        may_found: bool = True,
        log_entries: int = 8192,
        log_bytes: int = 64 << 20,
    ) -> None:
        super().__init__(epoch, mark=mark, log_entries=log_entries, log_bytes=log_bytes)
        self.members: tuple[int, ...] = ()
        self.committed = -1
        self.listed = 0  # how many replicas the pool has, reached or not
        self.behind = False  # the furthest state lacks what this robot was answered
        self.holder: str | None = None
        self._founders = founders
        self._may_found = may_found and mark == START
        self._votes: dict[int, Vote] = {}
        self._acks: dict[int, int] = {}  # by member: a fact once said, whatever becomes of it
        self._members_at = 0
        self._numbered: dict[RequestId, int] = {}
        self._own: dict[int, int] = {}
        self._answers: dict[int, bytes] = {}
        self._answered: list[Answered] = []
        self._backlog: deque[Handed] = deque()
        self._passed_on = 0
        self._listens: dict[int, _Listen] = {}
        self._gone_since: dict[int, float] = {}

    # -- what the owner asks --------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Whether a number given now can be committed."""
        here = {self._votes[r].member for r in self.joined if r in self._votes}
        return is_majority(here, self.members)

    def take_answers(self) -> list[Answered]:
        """Return the answers that have come, and forget them."""
        answered, self._answered = self._answered, []
        return answered

    def number(self, id: RequestId, floor: int, body: bytes, *, wanted: bool) -> bool:
        """Number a request, if it has none; whether it has one now.

        Args:
            id: Which it is.
            floor: Its robot awaits no answers below this.
            body: What the service is to be given.
            wanted: Whether our own robot asks.
        """
        if id in self._numbered:
            return True
        index = self._append(Entry(id, floor, body, wanted).encode())
        if index is None:
            return False
        self._numbered[id] = index
        if wanted:
            self._own[index] = id.seq
        else:
            self._passed_on = index
        return True

    def under_way(self, id: RequestId) -> bool:
        """Whether a request has a number that is not committed yet."""
        return self._numbered.get(id, -1) > self.committed

    # -- how a term begins ----------------------------------------------------------------

    def _read_promise(self, replica: int, payload: bytes) -> Promise:
        vote = self._votes[replica] = shared_orders.decode_vote(payload)
        if vote.sound and vote.position.epoch == self.epoch:
            self._ack(vote.member, vote.position.index)
        return Promise(vote.position, vote.sound)

    def _lead(self, replica: int, peer: Peer) -> None:
        claimed = {
            r: self._votes[r] for r, p in self._peers.items() if p.phase is Phase.CLAIMED
        }  # fmt: skip
        counting = {r: vote for r, vote in claimed.items() if vote.sound and vote.whole}
        knowing = {r: vote for r, vote in counting.items() if vote.members}
        if knowing:
            furthest = max(knowing, key=lambda r: knowing[r].position)
            best = knowing[furthest]
            self.behind = best.position < self.mark
            if is_majority({v.member for v in counting.values()}, best.members) and not self.behind:
                self._start(best.position, best.members, self._version(furthest))
        elif self._may_found and len(counting) == len(self._peers) == max(self.listed, 1):
            versions = {self._version(r) for r in counting}
            if len(counting) >= self._founders and len(versions) == 1:
                members = tuple(sorted(vote.member for vote in counting.values()))
                self._start(max(v.position for v in counting.values()), (), versions.pop())
                self._change_members(members)

    def _start(self, at: Position, members: tuple[int, ...], version: str) -> None:
        self.holder, self.members, self._members_at = version, members, at.index
        self._begin_at(at)
        self._bring_all()

    def _counts(self, replica: int) -> bool:
        return self._version(replica) == self.holder

    def _bring(self, replica: int, peer: Peer, *, waited: bool = False) -> None:
        if self._counts(replica):  # two versions never answer side by side
            super()._bring(replica, peer, waited=waited)

    def _has_own_state(self, replica: int, at: Position) -> bool:
        first = at.index == 0  # whoever obeyed: it is the state in which the service starts
        return first or super()._has_own_state(replica, at)

    def _to_bring(self, replica: int, payload: bytes) -> bytes:
        return shared_orders.encode_word(self._votes[replica].life, payload)

    def _has_joined(self, replica: int, peer: Peer, expected: int, applied: int) -> None:
        if replica in self._votes:  # else it is of a link that is gone, and was claimed anew
            super()._has_joined(replica, peer, expected, applied)

    def _read_joined(self, replica: int, payload: bytes) -> tuple[int, int]:
        member, expected, applied = shared_orders.decode_joined(payload)
        self._ack(member, applied)
        self._listens.pop(replica, None)
        return expected, applied

    # -- what is committed ----------------------------------------------------------------

    def _applied(self, replica: int, index: int, payload: bytes) -> bool:
        member, answer = shared_orders.decode_applied(payload)
        if answer is not None and index in self._own:
            self._answers[index] = answer
        self._ack(member, index)
        return False

    def _recall(self, replica: int, before: int) -> None:
        """An answer that never came is asked for as other robots do: by handing it in."""

    def _ack(self, member: int, index: int) -> None:
        """Take note that a member, obeying this term, has applied all up to a number."""
        self._acks[member] = max(index, self._acks.get(member, -1))
        acks = sorted((self._acks.get(m, -1) for m in self.members), reverse=True)
        if acks:
            self.committed = max(self.committed, acks[len(acks) // 2])
        for own in [i for i in self._answers if i <= self.committed]:
            at = Position(self.epoch, own)
            self.mark = max(self.mark, at)
            self._answered.append(Answered(self._own.pop(own), at, self._answers.pop(own)))

    # -- who the members are --------------------------------------------------------------

    def _change_members(self, members: tuple[int, ...]) -> None:
        index = self._append(Entry(members=members).encode())
        if index is not None:
            self.members, self._members_at = members, index

    def _see_to_members(self, now: float) -> None:
        """Let go who is gone, and take in who has caught up: one, then wait for a majority."""
        base = self.base
        if base is None or self.committed < max(self._members_at, base.index):
            return
        here = {self._votes[r].member for r in self._peers if r in self._votes}
        joined = {
            self._votes[r].member: r
            for r in self.joined
            if self._counts(r) and r not in self._leaving
        }
        gone = [member for member in self.members if member not in here]
        self._gone_since = {m: self._gone_since.get(m, now) for m in gone}
        for member, since in self._gone_since.items():
            if now - since >= GONE_AFTER_S and len(self.members) > self._founders:
                self._change_members(tuple(m for m in self.members if m != member))
                return
        for member in joined.keys() - set(self.members):
            if self._acks.get(member, -1) >= self.committed:
                self._change_members((*self.members, member))
                return

    # -- what robots hand in --------------------------------------------------------------

    def _govern(self, now: float) -> None:
        if self.base is None:
            for replica, peer in self._peers.items():
                if self.base is None and peer.phase is Phase.CLAIMED:
                    self._lead(replica, peer)
        else:
            self._number_backlog()
            self._see_to_members(now)
            self._forget_old()
        self._listen(now)

    def _number_backlog(self) -> None:
        while self._backlog:
            handed = self._backlog[0]
            if not self.number(handed.id, handed.floor, handed.body, wanted=False):
                return
            self._backlog.popleft()

    def _forget_old(self) -> None:
        """Replicas know who asked what: here it only saves numbers."""
        log = self.log
        if log is not None and len(self._numbered) > 2 * self._bounds[0]:
            old = min(log.start, self.committed)
            self._numbered = {id: n for id, n in self._numbered.items() if n > old}
            self._own = {n: seq for n, seq in self._own.items() if n > old}

    def _listen(self, now: float) -> None:
        """Let every replica that obeys know that we live, and what is committed."""
        for replica, peer in self._peers.items():
            if peer.phase is Phase.UNCLAIMED:
                continue
            listen = self._listens.setdefault(replica, _Listen())
            news = listen.told < min(self.committed, self._passed_on)
            if listen.open >= _LISTENS_LIMIT or not (news or now - listen.sent_at >= HEARTBEAT_S):
                continue
            listen.sent_at, listen.told = max(listen.sent_at, now), self.committed
            listen.open += 1
            payload = shared_orders.encode_listen(max(self.committed, 0), again=listen.again)
            listen.again = False
            self._order(replica, Op.LISTEN, payload)

    def replied(self, replica: int, op: Op, index: int, payload: bytes) -> bool:
        """Take a reply; answers are had by `take_answers`. Raises OrderError."""
        if op is not Op.LISTEN:
            before = self.committed
            super().replied(replica, op, index, payload)
            if before < self._passed_on and before < self.committed:
                self._listen(float("-inf"))
            return False
        listen = self._listens.get(replica)
        if listen is not None:
            listen.open = max(0, listen.open - 1)
        handed = shared_orders.decode_handed(payload)
        if handed:
            self._backlog.extend(handed)
            self._number_backlog()
            if listen is not None:
                listen.sent_at = float("-inf")
        return False

    def refused(self, replica: int, op: Op, index: int, reason: str, now: float) -> None:
        """Take a refusal, or the loss of an order: the replica may or may not have obeyed it."""
        if op is Op.LISTEN:
            self._listens.pop(replica, None)
            peer = self._peers.get(replica)
            obeyed = orders.read_fenced(reason)
            if obeyed is None or (obeyed < self.epoch and (peer is None or peer.promise is None)):
                return  # nothing is known by it: the claim is still on its way, or the link died
        super().refused(replica, op, index, reason, now)

    def declined(self, replica: int, op: Op, index: int, now: float) -> None:
        """An order was not taken by the link: it was not sent."""
        if op is Op.LISTEN:
            listen = self._listens.get(replica)
            if listen is not None:
                listen.open, listen.again = max(0, listen.open - 1), True
            return
        super().declined(replica, op, index, now)

    def _drop(self, replica: int) -> None:
        super()._drop(replica)
        self._votes.pop(replica, None)
        self._listens.pop(replica, None)
