"""Close connections at a replica's port that belong to no admitted robot or are stuck.

Zenoh has room for 32 unauthenticated connections, keeps them for ever, and accepts nobody else
meanwhile. So we check this process's own sockets, periodically and whenever somebody connects:
strangers (unauthenticated connections) are closed or kept out as `door` decides. Links of a revoked
holder, and those of one holder beyond `LINKS_LIMIT`, are closed at once; links that deliver none
of their queued bytes are closed after a while. All are counted. If strangers hold all descriptors
that the process may have, all of them are closed. Each check also finds out which links are slow.
"""

import contextlib
import logging
import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import KW_ONLY, dataclass

from fogft.counters import Counters
from fogft.link.socket_progress import SocketProgress
from fogft.link.zenoh import sockets
from fogft.link.zenoh.flow_watch import THIN_BYTES_PER_S
from fogft.link.zenoh.replica.door import Door
from fogft.link.zenoh.replica.listen_filter import ListenFilter
from fogft.link.zenoh.sockets import Address

log = logging.getLogger(__name__)

LOOK_EVERY_S = 0.5
_QUIET_EVERY_S = 1.0  # while there are no strangers
_LOOK_AGAIN_S = 0.01  # while somebody connects, or is kept out
RUSH_LIMIT = 2  # new connections since the last look
# Per holder; the newest are kept: a robot has one per uplink, and another while it switches to a
# new certificate. Zenoh has room for 128 of all holders together.
LINKS_LIMIT = 16
# Descriptors held in reserve against floods. With none left, the connections at the port cannot be
# attributed, no preemption notice is read and no state is written.
_RESERVE = 32


def surplus(links: Mapping[Address, str]) -> list[Address]:
    """Return the links (peer -> holder, oldest first) beyond each holder's newest `LINKS_LIMIT`."""
    newer = Counter(links.values())
    found = []
    for peer, name in links.items():
        if newer[name] > LINKS_LIMIT:
            found.append(peer)
        newer[name] -= 1
    return found


@dataclass(eq=False)
class ConnectionReaper:
    """Watches one port until closed; keeps in `thin` the holders with a slow link.

    `links` returns the peers' addresses of authenticated links, with their holders; a link is stuck
    if it delivered none of its queued bytes for `stuck_after_s`. `also` is called at each look.
    """

    port: int
    links: Callable[[], Mapping[Address, str]]
    revoked: Callable[[], Collection[str]]
    counters: Counters
    _: KW_ONLY
    thin: set[str]
    also: Callable[[], None]
    stuck_after_s: float

    def __post_init__(self) -> None:
        self._progress: dict[Address, SocketProgress] = {}
        self._linked: dict[Address, str] = {}  # oldest first
        self._filter = ListenFilter(self.port)
        self._door = Door()
        self._reserve: list[int] = []
        self._fill_reserve()
        self._shut = self._strange = False
        self._descriptors = sockets.count()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fogft-reaper", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop watching."""
        self._stop.set()
        self._thread.join(1.0)

    def _run(self) -> None:
        self._await_look()
        while not self._stop.is_set():
            try:
                self.look(time.monotonic())
                self.also()
            except Exception:
                log.exception("doorkeeper_failed port=%d", self.port)
                self._filter.drop(frozenset())
            self._await_look()
        self._filter.close()
        self._release_reserve()

    def _fill_reserve(self) -> bool:
        """Fill the reserve; return False if no other descriptor is left."""
        try:
            while len(self._reserve) <= _RESERVE:
                self._reserve.append(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))
        except OSError:
            return False
        os.close(self._reserve.pop())
        return True

    def _release_reserve(self) -> None:
        while self._reserve:
            os.close(self._reserve.pop())

    def _await_look(self) -> None:
        """Wait until it is time to look: soon after a connection came, at once in a rush."""
        began = time.monotonic()
        every_s = LOOK_EVERY_S if self._strange else _QUIET_EVERY_S
        until = began + (_LOOK_AGAIN_S if self._shut else every_s)
        while (left_s := until - time.monotonic()) > 0 and self._filter.wait(left_s):
            if sockets.count() >= self._descriptors + RUSH_LIMIT:
                self._filter.drop(None)  # until it is known whose the new ones are
                return
            until = min(until, began + _LOOK_AGAIN_S)
            time.sleep(_LOOK_AGAIN_S / 50)

    def look(self, now: float) -> None:
        """Check once, and close the connections that must go."""
        short = not self._fill_reserve()
        if short:
            self._filter.drop(None)  # first: the released descriptors are not for strangers
            self._release_reserve()
            self.counters.warn(log, "descriptors_short", "descriptors_short port=%d", self.port)
        with contextlib.ExitStack() as stack:
            found = {
                peer: stack.enter_context(connection)
                for peer, connection in sockets.connections(self.port)
            }
            links = self.links()  # after the sockets: one admitted meanwhile is no stranger
            revoked = self.revoked()
            for peer, name in links.items():
                if name in revoked and peer in found:
                    self._end(found[peer], peer, "revoked_links", name)
            kept = {peer: name for peer, name in self._linked.items() if links.get(peer) == name}
            self._linked = {**kept, **links}
            for peer in surplus(self._linked):
                if peer in found:
                    self._end(found[peer], peer, "surplus_links", links[peer])
            self._watch(links, found, now)
            strangers = found.keys() - links.keys()
            self._strange = bool(strangers)
            gone = self._door.look(strangers, links.keys(), now)
            for stranger in strangers if short else () if gone is None else (gone,):
                self._end(found[stranger], stranger, "unauthenticated", "")
            # If there are no strangers to close, something else uses up the descriptors.
            self._keep_out(None if short and strangers else self._door.kept_out)
        self._descriptors = sockets.count()

    def _keep_out(self, hosts: frozenset[str] | None) -> None:
        self._filter.drop(hosts)
        shut = hosts is None or bool(hosts)
        if shut and not self._shut:
            self.counters.warn(
                log, "kept_out", "door_shut hosts=%s", "all" if hosts is None else sorted(hosts)
            )
            self._filter.turn_away()
        self._shut = shut

    def _watch(
        self, links: Mapping[Address, str], found: Mapping[Address, socket.socket], now: float
    ) -> None:
        """Measure the progress of links: find the slow ones, and close the stuck ones."""
        thin = set()
        progress = {
            peer: self._progress.get(peer) or SocketProgress() for peer in links if peer in found
        }
        for peer, one in progress.items():
            flow = sockets.flow(found[peer])
            if flow is None:
                continue
            one.look(flow, now)
            rate = one.throughput.steady_bytes_per_s
            if rate is not None and rate < THIN_BYTES_PER_S:
                thin.add(links[peer])
                sockets.keep_short(found[peer])
            if one.stuck_s(now) > self.stuck_after_s:
                self._end(found[peer], peer, "stuck_links", links[peer])
        self._progress = progress
        self.thin &= thin
        self.thin |= thin

    def _end(self, connection: socket.socket, peer: Address, event: str, name: str) -> None:
        sockets.end(connection)
        self.counters.warn(
            log, event, "connection_ended reason=%s peer=%s:%d name=%r", event, *peer, name
        )
