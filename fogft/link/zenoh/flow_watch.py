"""Watch what flows through one link's connection, and end it beneath Zenoh where nothing does.

Owns: a connection's socket. Not here: the judgement (`socket_progress`), when to look (`link`).
"""

import select
import time
from collections.abc import Callable

from fogft import poll
from fogft.link.socket_progress import BULK_BYTES, SocketProgress
from fogft.link.zenoh import sockets
from fogft.link.zenoh.sockets import Address, OwnSocket

THIN_BYTES_PER_S = 2_000_000.0  # below, what is large is kept short in the kernel
_END_WITHIN_S = 1.0  # so long a closed connection may still flow
_LOOK_AGAIN_S = 0.002
_QUIET_S = 0.05  # nothing came for so long: no large answer is on its way


class FlowWatch:
    """Watches one connection's socket. For one thread, but for `end_when_safe`."""

    def __init__(self, own: Address, peer: Address) -> None:
        self._socket = OwnSocket(own, peer)
        self.progress = SocketProgress()
        self._kept_short = False

    @property
    def thin(self) -> bool:
        """Whether it was seen to drain slowly."""
        rate = self.progress.bytes_per_s
        return rate is not None and rate < THIN_BYTES_PER_S

    def look(self, now: float, sending_for_s: float = 0.0) -> float:
        """Look once; return for how many of the last seconds large things moved."""
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

    def end_when_safe(self, sending: Callable[[], bool], asked: Callable[[], bool]) -> None:
        """End the connection where something large may be on its way, either way; may block.

        Zenoh's thread and a sender may wait for each other where an end meets a flow: see
        `docs/design/links.md`. So what flows fast is let through, and what is stuck is ended.
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
                    if not poll.is_ready(connection, event=select.POLLOUT):  # in the kernel
                        sockets.end_sending(connection)  # at once: soon it may take more
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
