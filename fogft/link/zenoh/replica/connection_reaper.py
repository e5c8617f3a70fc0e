"""Close connections at a replica's port that belong to no admitted robot, or deliver nothing.

Zenoh owns the port. It lets a connection that never says who it is stand for as long as it
likes, keeps room for 32 of them, and lets nobody else in meanwhile. So we look ourselves,
four times a second, at this process's own sockets: what is connected to the port and is no
authenticated link is ended when it is too old or when there are too many, a link of a revoked
holder at once, and one that delivers nothing of what it holds after a while. All are counted.
Who looks sees, too, which links are thin.

Owns: ending connections, and how they drain. Not here: whose requests are refused (`sessions`).
"""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
import time
from collections.abc import Callable, Collection, Mapping

from fogft.link.counters import Counters
from fogft.link.socket_progress import SocketProgress
from fogft.link.zenoh import sockets
from fogft.link.zenoh.flow_watch import THIN_BYTES_PER_S
from fogft.link.zenoh.sockets import Address

log = logging.getLogger(__name__)

LOOK_EVERY_S = 0.25
# Longer than Zenoh takes to accept or give up a peer that talks.
PATIENCE_S = 5.0
STRANGERS_LIMIT = 16
# In a flood even the young have to go, but not one that may be in the middle of its handshake.
LEAST_AGE_S = 0.5
# A robot that is out of reach has long opened another link by then.
STUCK_AFTER_S = 15.0


class ConnectionReaper:
    """Looks after one port until closed.

    Args:
        port: The port that this process listens at.
        links: Returns the peers' addresses of authenticated links, with their common names.
        revoked: Returns the names whose links are to be ended.
        counters: Counts ``unauthenticated``, ``revoked_links`` and ``stuck_links`` ended.
        also: Called with each look.
        stuck_after_s: Links are ended that have bytes to deliver, and delivered none for so long.

    Attributes:
        thin: Common names of those to whom a link is thin.
    """

    def __init__(
        self,
        port: int,
        links: Callable[[], Mapping[Address, str]],
        revoked: Callable[[], Collection[str]],
        counters: Counters,
        *,
        also: Callable[[], None] = lambda: None,
        stuck_after_s: float = STUCK_AFTER_S,
    ) -> None:
        self._port = port
        self._links = links
        self._revoked = revoked
        self._counters = counters
        self._also = also
        self._stuck_after_s = stuck_after_s
        self.thin: frozenset[str] = frozenset()
        self._first_seen: dict[Address, float] = {}
        self._progress: dict[Address, SocketProgress] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fogft-reaper", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop looking."""
        self._stop.set()
        self._thread.join(1.0)

    def _run(self) -> None:
        while not self._stop.wait(LOOK_EVERY_S):
            try:
                self.look(time.monotonic())
                self._also()
            except Exception:
                log.exception("doorkeeper_failed port=%d", self._port)

    def look(self, now: float) -> None:
        """Look once, and end what has to go."""
        with contextlib.ExitStack() as stack:
            found = {
                peer: stack.enter_context(connection)
                for peer, connection in sockets.connections(self._port)
            }
            links = self._links()  # after the sockets: who is in by now is no stranger
            revoked = self._revoked()
            for peer, name in links.items():
                if name in revoked and peer in found:
                    self._end(found[peer], peer, "revoked_links", name)
            self._watch(links, found, now)
            seen = {peer: self._first_seen.get(peer, now) for peer in found if peer not in links}
            for peer in condemned(seen, now):
                self._end(found[peer], peer, "unauthenticated", "")
                del seen[peer]
            self._first_seen = seen

    def _watch(
        self, links: Mapping[Address, str], found: Mapping[Address, socket.socket], now: float
    ) -> None:
        """See how links drain: find the thin ones, and end those that stand still.

        A peer that has acknowledged nothing for long is frozen, or out of reach.
        """
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
            if one.stuck_s(now) > self._stuck_after_s:
                self._end(found[peer], peer, "stuck_links", links[peer])
        self._progress = progress
        self.thin = frozenset(thin)

    def _end(self, connection: socket.socket, peer: Address, event: str, name: str) -> None:
        sockets.end(connection)
        self._counters.warn(
            log, event, "connection_ended reason=%s peer=%s:%d name=%r", event, *peer, name
        )


def condemned(strangers: Mapping[Address, float], now: float) -> list[Address]:
    """Return which strangers have to go: those too old, and the oldest of too many. Pure.

    Args:
        strangers: When each was first seen.
        now: The same clock.
    """
    by_age = sorted(strangers, key=lambda peer: strangers[peer])
    surplus = by_age[: max(0, len(by_age) - STRANGERS_LIMIT)]
    return [
        peer
        for peer in by_age
        if now - strangers[peer] >= (LEAST_AGE_S if peer in surplus else PATIENCE_S)
    ]
