"""See to the connections at a replica's port that are nobody's, or nobody's any more.

Zenoh owns the port. It lets a connection that never says who it is stand for as long as it
likes, keeps room for 32 of them, and lets nobody else in meanwhile. So we look ourselves,
four times a second, at this process's own sockets: what is connected to the port and is no
authenticated link is ended when it is too old or when there are too many, and a link of a
revoked holder is ended at once. Both are counted.

Owns: ending connections. Not here: whose requests are refused (`guests`).
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path

from fogft.wire.reply_queue import Counters

log = logging.getLogger(__name__)

LOOK_EVERY_S = 0.25
# Longer than Zenoh takes to accept or give up a peer that talks.
PATIENCE_S = 3.0
STRANGERS_LIMIT = 16
# In a flood even the young have to go, but not one that may be in the middle of its handshake.
LEAST_AGE_S = 0.5

Address = tuple[str, int]
_DESCRIPTORS = Path("/proc/self/fd")


class Doorkeeper:
    """Looks after one port until closed.

    Args:
        port: The port that this process listens at.
        links: Returns the peers' addresses of authenticated links, with their common names.
        revoked: Returns the names whose links are to be ended.
        counters: Counts ``unauthenticated`` and ``revoked_links`` ended.
        also: Called with each look.
    """

    def __init__(
        self,
        port: int,
        links: Callable[[], Mapping[Address, str]],
        revoked: Callable[[], Collection[str]],
        counters: Counters,
        *,
        also: Callable[[], None] = lambda: None,
    ) -> None:
        self._port = port
        self._links = links
        self._revoked = revoked
        self._counters = counters
        self._also = also
        self._first_seen: dict[Address, float] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fogft-doorkeeper", daemon=True)
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
                for peer, connection in _connections(self._port)
            }
            links = self._links()  # after the sockets: who is in by now is no stranger
            revoked = self._revoked()
            for peer, name in links.items():
                if name in revoked and peer in found:
                    self._end(found[peer], peer, "revoked_links", name)
            seen = {peer: self._first_seen.get(peer, now) for peer in found if peer not in links}
            for peer in condemned(seen, now):
                self._end(found[peer], peer, "unauthenticated", "")
                del seen[peer]
            self._first_seen = seen

    def _end(self, connection: socket.socket, peer: Address, event: str, name: str) -> None:
        with contextlib.suppress(OSError):  # it ended by itself
            connection.shutdown(socket.SHUT_RDWR)
        count = self._counters.add(event)
        if count & (count - 1) == 0:
            log.warning(
                "connection_ended reason=%s peer=%s:%d name=%r count=%d", event, *peer, name, count
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


def address(endpoint: str) -> Address:
    """Return host and port of a Zenoh endpoint such as ``tls/[::1]:7447``.

    Raises:
        ValueError: It is none.
    """
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    return _plain(host.strip("[]")), int(port.partition("?")[0].partition("#")[0])


def _plain(host: str) -> str:
    return host.removeprefix("::ffff:") if "." in host else host


def _connections(port: int) -> Iterator[tuple[Address, socket.socket]]:
    """Yield this process's TCP connections at a port, each as a socket of our own to it."""
    try:
        numbers = [int(entry.name) for entry in _DESCRIPTORS.iterdir()]
    except OSError:
        return  # no Linux: nothing can be seen to
    for number in numbers:
        try:
            if not os.readlink(_DESCRIPTORS / str(number)).startswith("socket:"):
                continue
            connection = socket.socket(fileno=os.dup(number))
        except OSError:
            continue  # closed in between
        try:
            at_port = (
                connection.family in (socket.AF_INET, socket.AF_INET6)
                and connection.type == socket.SOCK_STREAM
                and connection.getsockname()[1] == port
            )
            peer = connection.getpeername() if at_port else None
        except OSError:
            peer = None  # it listens, or is no longer connected
        if peer is None:
            connection.close()
        else:
            yield (_plain(peer[0]), peer[1]), connection
