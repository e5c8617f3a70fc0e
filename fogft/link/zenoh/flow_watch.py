"""Watch the progress of one link's socket, and shut the socket down beneath Zenoh if it is stuck.

Owns: a connection's socket. Not here: the decision (`socket_progress`), when to look (`link`).
"""

import select
import time
from collections.abc import Callable

from fogft import poll
from fogft.link.socket_progress import BULK_BYTES, SocketProgress
from fogft.link.zenoh import sockets

THIN_BYTES_PER_S = 2_000_000.0  # below this, the kernel's queue of unsent bytes is kept short
_END_WITHIN_S = 1.0  # how long a connection that is being closed may still move data
_LOOK_AGAIN_S = 0.002
_QUIET_S = 0.05  # if nothing was received for this long, no large answer is in transit


class FlowWatch:
    """Watches one connection's socket. For one thread, except `end_when_safe`."""

    def __init__(self, own: sockets.Address, peer: sockets.Address) -> None:
        self._socket = sockets.OwnSocket(own, peer)
        self.progress = SocketProgress()
        self._kept_short = False

    @property
    def thin(self) -> bool:
        """Whether it was measured to be slow."""
        rate = self.progress.bytes_per_s
        return rate is not None and rate < THIN_BYTES_PER_S

    def look(self, now: float, sending_for_s: float = 0.0) -> float:
        """Check the socket once; return for how many seconds since the last check data moved."""
        connection = self._socket.borrow()
        if connection is None:
            return 0.0
        with connection:
            flow = sockets.flow(connection)
            if flow is None:
                return 0.0
            moved_s = self.progress.look(flow, now, sending_for_s)
            if self.thin and not self._kept_short:
                sockets.keep_short(connection)
                self._kept_short = True
        return moved_s

    def end_when_safe(self, sending: Callable[[], bool], asked: Callable[[], object]) -> None:
        """End the connection if a large message may be in transit, in either direction; may block.

        If a connection ends while data flows, Zenoh's thread and a sender may deadlock: see
        `docs/design/links.md`. So data that flows is let through, and a stuck send is cut off.
        """
        deadline = time.monotonic() + _END_WITHIN_S
        received, quiet_since = -1, 0.0
        while time.monotonic() < deadline:
            connection = self._socket.borrow()
            if connection is None:
                return
            with connection:
                flow = sockets.flow(connection)
                if flow is None or not (sending() or asked()):
                    break
                if sending():
                    if not poll.is_ready(connection, event=select.POLLOUT):  # stuck in the kernel
                        sockets.end_sending(connection)  # at once: it may accept more soon
                        return
                elif flow.received != received:
                    received, quiet_since = flow.received, time.monotonic()
                elif time.monotonic() - quiet_since > _QUIET_S:
                    break
            time.sleep(_LOOK_AGAIN_S)
        connection = self._socket.borrow()
        if connection is None:
            return
        with connection:
            flow = sockets.flow(connection)
            if sending() or (flow is not None and flow.outstanding >= BULK_BYTES):
                sockets.end_sending(connection)
            elif asked():
                sockets.abort(connection)
