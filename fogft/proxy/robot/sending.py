"""Offer one service's requests to links, and cancel requests at links.

The only place where a request is sent to a replica. Which links may be asked: `proxied_service`.
"""

import threading
from collections.abc import Collection, Iterable, Mapping, Sequence
from types import MappingProxyType

from fogft.link.port import Link
from fogft.model.choices import Freshness
from fogft.model.replica import ReplicaId
from fogft.proxy.robot.ledger import Ledger
from fogft.requests.decide import Reachable
from fogft.requests.load import Handling


class Sender:
    """Sends one service's requests."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        decide = ledger.requests.decide
        self._replication = decide if decide.replicates else None
        self._sending = threading.Lock()  # keeps replicated requests in order
        self._in_burst = False
        self._hanging: set[int] = set()
        self.links: dict[int, Link] = {}  # links that may be asked, by replica
        self.able: tuple[int, ...] = ()  # the replicas that the policy may choose

    def burst(self, begins: bool) -> None:
        """Begin or end a burst: what is sent until its end is batched into few messages."""
        self._in_burst = begins
        if not begins:
            for link in list(self.links.values()):
                link.send()

    def first(
        self, request: bytes, payload: bytes, links: Mapping[int, Link], chosen: Sequence[int],
        timeout_s: float,
    ) -> int:  # fmt: skip
        """Offer a new request to its chosen replicas; return how many accepted it."""
        name, is_spare = self._ledger.spec.name, self._ledger.requests.choose.is_spare
        several, taken = len(chosen) > 1, 0  # a single copy is never a spare
        for replica in chosen:
            spare = several and is_spare(request, replica)
            handling = Handling.DROP_IF_BUSY if spare else Handling.NORMAL
            if links[replica].offer(
                name, request, payload, timeout_s, more=self._in_burst, handling=handling
            ):
                taken += 1
            else:
                self._declined(request, replica, is_copy=True)
        self._count(taken)
        if several and request not in self._ledger.requests:
            # Answered before the last link had it: that link was not told of the end.
            self.forget(request, chosen)
        return taken

    def route(
        self,
        links: Sequence[Link],
        versions: Mapping[ReplicaId, str] = MappingProxyType({}),
        draining: Collection[ReplicaId] = (),
        hanging: Collection[ReplicaId] = (),
    ) -> None:
        """Set the links that may be asked now, and offer them open requests.

        Replicas in `hanging` may be among them: they report that their service is not responding.
        """
        routed = {key_of(link): link for link in links}
        replication, now = self._replication, self._ledger.clock()
        hang = {key for key, link in routed.items() if link.peer.id in hanging}
        with self._ledger.lock:
            added = [key for key, link in routed.items() if self.links.get(key) is not link]
            self._ledger.requests.left(self.links.keys() - routed.keys())
            self.links = routed
            if versions:
                members = routed.keys() | {id.key for id in versions}
                self._ledger.requests.choose.keep(members)
                self._ledger.outcomes.keep(members)
            if replication is None or not replication.sends_requests:
                self.able = tuple(routed)
                self._ledger.requests.came(added)
            if replication is not None:
                known = {key: versions.get(x.peer.id, "") for key, x in routed.items()}
                drain = [key for key, link in routed.items() if link.peer.id in draining]
                replication.reach(Reachable(added, known, drain), now)
            told, self._hanging = hang - self._hanging, hang
            for key in told:
                self._ledger.requests.choose.hangs(key)
        if added or told:
            self.offer_more(now)
        self.replicate()

    def offer_more(self, now: float) -> float:
        """Send open requests to more replicas as the policy says; return when to call again."""
        newest_first = self._ledger.spec.freshness is Freshness.LATEST
        with self._ledger.lock:
            links, requests = self.links, self._ledger.requests
            steps = requests.more(self.able, now, newest_first=newest_first)
            look_at = requests.choose.look_at
        full: set[int] = set()  # a replica that declined a request just now is offered no other
        for request, replica in steps:
            if not self._offer(request, replica, links[replica], skip=replica in full):
                full.add(replica)
        return look_at

    def _offer(self, request: bytes, replica: int, link: Link, *, skip: bool) -> bool:
        now = self._ledger.clock()
        with self._ledger.lock:
            requests = self._ledger.requests
            if skip:
                requests.choose.declined(request, replica, full=False)
                return False
            pending = requests.attempt(request, replica, now)
            if pending is None:
                return True
            if pending.trace is not None:
                pending.trace.asked.setdefault(replica, now)
            handling = Handling.ALONE if pending.deaths else Handling.NORMAL
            if handling is Handling.NORMAL and requests.choose.is_spare(request, replica):
                handling = Handling.DROP_IF_BUSY
        name, remaining_s = self._ledger.spec.name, pending.deadline - now
        if not link.offer(name, request, pending.payload, remaining_s, handling=handling):
            self._declined(request, replica, is_copy=True)
            return False
        self._count(1)
        if request not in requests:  # it was answered meanwhile
            self.forget(request, (replica,))
        return True

    def replicate(self) -> None:
        """Send everything that must be replicated."""
        replication, ledger = self._replication, self._ledger
        if replication is None:
            return
        with self._sending:
            with ledger.lock:
                links = self.links
                sends = replication.take(ledger.clock(), ledger.spec.timeout_s)
            for replica, id, payload, timeout_s, is_copy in sends:
                link = links.get(replica)
                if link is None or not link.offer(ledger.spec.name, id, payload, timeout_s):
                    self._declined(id, replica, is_copy=is_copy)
                else:
                    self._count(is_copy)

    def _count(self, taken: int) -> None:
        with self._ledger.lock:
            self._ledger.outcomes.count["sent"] += taken

    def _declined(self, id: bytes, replica: int, *, is_copy: bool) -> None:
        with self._ledger.lock:
            pending = self._ledger.requests.get(id)
            if pending is not None and pending.trace is not None:
                asked = pending.trace.asked
                if asked.get(replica) == pending.open.get(replica):  # earlier attempts stay
                    asked.pop(replica, None)
            if is_copy:
                self._ledger.requests.declined(id, replica)
            if self._replication is not None:
                self._replication.declined(id, replica, self._ledger.clock())

    def forget(self, request: bytes, replicas: Iterable[int]) -> None:
        """Tell replicas that a request has ended."""
        requests = self._ledger.requests
        if requests.decide.hears_out(request):
            return
        for replica in replicas:
            link = self.links.get(replica)
            if link is not None:
                link.forget(request)


def key_of(link: Link) -> int:
    """Return the key of a link's replica."""
    return link.peer.id.key
