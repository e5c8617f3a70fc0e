"""Bring each replica of a stateful service up to date with one term's log. Pure.

It is sent the requests that it lacks while the log has them, else a checkpoint and the requests
after it. Orders are collected until `take`. Not here: answers, and who obeys (`sequencer`).
Protocol: docs/design/state.md.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from fogft.ordering import orders
from fogft.ordering.orders import START, Op, Position
from fogft.ordering.peer import LAG_LIMIT, Order, Peer, Phase

CHECKPOINT_RETRY_S = 1.0
WINDOW = 128


@dataclass(frozen=True)
class Checkpoint:
    """A snapshot by the service itself, taken after request `index`."""

    index: int
    state: bytes


class OrderedLog:
    """Requests by number, consecutive from `start` + 1, bounded by count and bytes."""

    entries_limit = 8192
    bytes_limit = 64 << 20  # of all together; a larger single entry still gets in alone

    def __init__(self, start: int) -> None:
        self.start = start
        self.checkpoint: Checkpoint | None = None
        self._entries: deque[bytes] = deque()
        self.held_bytes = 0  # bytes of all entries, without the checkpoint

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def last(self) -> int:
        """The highest number assigned."""
        return self.start + len(self._entries)

    def has_room(self, size: int) -> bool:
        """Whether a request of this size can be appended."""
        if not self._entries:
            return True
        within = self.held_bytes + size <= self.bytes_limit
        return within and len(self._entries) < self.entries_limit

    def append(self, payload: bytes) -> int:
        """Append a request and return its number; check `has_room` first."""
        self._entries.append(payload)
        self.held_bytes += len(payload)
        return self.last

    def get(self, index: int) -> bytes:
        """Return a request whose number is above `start`, and at most `last`."""
        return self._entries[index - self.start - 1]

    def empty(self, index: int) -> None:
        """Empty a request: it is applied without effect, like one that cannot be read."""
        self.held_bytes -= len(self.get(index))
        self._entries[index - self.start - 1] = b""

    def covers(self, index: int) -> bool:
        """Whether a replica at this index can be brought up to date from the log alone."""
        return self.start <= index <= self.last

    def keep(self, checkpoint: Checkpoint) -> None:
        """Store a newer snapshot, and drop the requests it covers. An older one is ignored."""
        old = self.checkpoint
        if not self.covers(checkpoint.index) or (old and old.index >= checkpoint.index):
            return
        self.checkpoint = checkpoint
        self.drop(checkpoint.index)

    def drop(self, index: int) -> None:
        """Drop all requests up to a number, and any earlier checkpoint."""
        while self._entries and self.start < index:
            self.held_bytes -= len(self._entries.popleft())
            self.start += 1
        if self.checkpoint is not None and self.checkpoint.index < self.start:
            self.checkpoint = None


class CatchingUp:
    """A term's log, and each replica's progress in it.

    A replica `counts` if its state may be given to others, and its answer to a caller. A term that
    was `handed_over` begins from the state of replicas of another version.
    """

    def __init__(self, epoch: int, counts: Callable[[int], bool], *, handed_over: bool) -> None:
        self.base: Position | None = None  # None until the term has begun
        self.log = OrderedLog(0)
        self.peers: dict[int, Peer] = {}
        self.donor: int | None = None  # the replica that was asked for a checkpoint
        self._epoch = epoch
        self._counts = counts
        self._handed_over = handed_over
        self.out: list[Order] = []  # what `take` returns next
        self._serial = 0
        self._checkpoint_at = 0.0

    @property
    def ready(self) -> bool:
        """Whether a request numbered now is sent at once to a replica whose answer counts."""
        return any(peer.joined and self._counts(replica) for replica, peer in self.peers.items())

    def take(self) -> list[Order]:
        """Remove and return the orders to send, in order."""
        out, self.out = self.out, []
        return out

    # -- numbers --------------------------------------------------------------------------

    def order(self, replica: int, op: Op) -> None:
        """Send an order without a number, identified by a serial."""
        self._serial += 1
        self.out.append(Order(replica, op, self._serial))

    def begin_at(self, position: Position) -> None:
        """Begin the term from a state."""
        self.base = position
        self.log.start = position.index

    def append(self, payload: bytes) -> int | None:
        """Number a request and order it applied; None before the term, or if the log is full."""
        log = self.log
        if self.base is None:
            return None
        if not log.has_room(len(payload)) and not self._make_room(len(payload)):
            return None
        index = log.append(payload)
        for replica, peer in self.peers.items():
            keeps_up = peer.joined and peer.next == index and peer.rewind is None
            if keeps_up and len(peer.open) < WINDOW:
                peer.next = index + 1
                peer.open.add(index)
                self.out.append(Order(replica, Op.APPLY, index, payload))
        return index

    def feed(self, replica: int, peer: Peer) -> None:
        """Send a joined replica the requests that it lacks."""
        log = self.log
        if not peer.joined or peer.lags:
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
                self.out.append(Order(replica, Op.APPLY, index, log.get(index)))

    def recall(self, replica: int, index: int) -> None:
        """Ask a replica for the answer to a number that it has applied."""
        peer = self.peers[replica]
        if index not in peer.open:
            peer.open.add(index)
            self.out.append(Order(replica, Op.RECALL, index))

    def _make_room(self, size: int) -> bool:
        """Without a checkpoint in time, drop requests that all members applied: none needs them."""
        members = [peer.acked for peer in self.peers.values() if peer.member]
        if members:
            self.log.drop(min(members))
        return self.log.has_room(size)

    # -- replicas that are behind ---------------------------------------------------------

    def bring(self, replica: int, peer: Peer, *, waited: bool = False) -> None:
        """Make a claimed replica join, from its own state or from the checkpoint.

        If both are too old, it waits for a new checkpoint, unless it has already `waited`.
        """
        log, promise = self.log, peer.promise
        if self.base is None or promise is None or peer.open:
            return
        at, kept = promise.position, log.checkpoint
        may_join = promise.sound and self._knows(replica, at) and log.covers(at.index)
        from_index = max(at.index if may_join else -1, kept.index if kept else -1)
        if log.last - from_index > LAG_LIMIT and self.ready and not waited:
            return
        if may_join and from_index == at.index:
            peer.phase = Phase.ASKED
            self.out.append(Order(replica, Op.JOIN, at.index, orders.encode_join(at, log.last)))
        elif kept is not None:
            peer.phase = Phase.ASKED
            payload = orders.encode_snapshot(log.last, kept.state)
            self.out.append(Order(replica, Op.RESTORE, kept.index, payload))

    def _knows(self, replica: int, at: Position) -> bool:
        """Whether this term can continue from a replica's state; not if it is a standby's."""
        if at.epoch == self._epoch:
            return True
        # A replica of the version that took over begins from the handed-over state.
        return at == self.base and not (self._handed_over and self._counts(replica))

    def bring_all(self, *, waited: bool = False) -> None:
        """Make all waiting replicas join."""
        for replica, peer in self.peers.items():
            if peer.phase is Phase.CLAIMED:
                self.bring(replica, peer, waited=waited)

    def look_at_lag(self, peer: Peer, now: float) -> None:
        """Restore a joined replica that falls behind, if another can provide its state."""
        given = any(
            self._keeps_up(other) and self._counts(replica) for replica, other in self.peers.items()
        )
        peer.lags = given and (peer.lags or peer.lag.too_far(self.log.last - peer.acked, now))
        if peer.lags and not peer.open:
            peer.lags, peer.phase, peer.retry_at = False, Phase.UNCLAIMED, now

    def _keeps_up(self, peer: Peer) -> bool:
        return peer.joined and self.log.last - peer.acked <= WINDOW

    # -- the checkpoint -------------------------------------------------------------------

    def see_to_checkpoint(self, now: float) -> None:
        """Request a checkpoint if one is needed."""
        log = self.log
        waits = any(peer.phase is Phase.CLAIMED for peer in self.peers.values())
        # A log that begins at the initial state, or has a checkpoint, needs none. A later term's
        # log begins at a position that a fresh replica does not know, even before any request.
        begins_later = log.checkpoint is None and (log.start > 0 or self.base != START)
        full = max(len(log) / log.entries_limit, log.held_bytes / log.bytes_limit)
        if waits or begins_later or full >= 0.5:
            # Prefer a replica that seldom answers first: it pauses for the snapshot.
            self.ask_for_checkpoint(
                [
                    (not self._keeps_up(peer), peer.won, replica)
                    for replica, peer in self.peers.items()
                    if peer.joined and self._counts(replica)
                ],
                now,
            )

    def ask_for_checkpoint(self, donors: list[tuple[bool, int, int]], now: float) -> None:
        """Ask the best of these replicas for a checkpoint, unless one was requested recently."""
        if donors and self.donor is None and now >= self._checkpoint_at:
            self.donor = min(donors)[-1]
            self._checkpoint_at = now + CHECKPOINT_RETRY_S
            self.order(self.donor, Op.SNAPSHOT)

    def take_checkpoint(self, index: int, state: bytes) -> None:
        """Store a checkpoint, and make the replicas that wait for one join."""
        self.log.keep(Checkpoint(index, state))
        self._checkpoint_at = 0.0
        self.bring_all(waited=True)
