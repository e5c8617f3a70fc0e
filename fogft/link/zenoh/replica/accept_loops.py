"""Several accept loops of Zenoh's at one port, of which one takes what comes.

Zenoh's accept loop rests for 0.1 s after each handshake that fails, and all that it has accepted
wait for that. So it has several: it listens at spare addresses too (`settings`), and their sockets
are moved to the replica's port here. The kernel gives new connections to one of them
(`SO_ATTACH_REUSEPORT_CBPF`, for which no privilege is needed); where that one rests while somebody
waits, to the next. What strangers cost then delays nobody who comes later, however many were let
in before anything could be done.

Owns: the listening sockets. Not here: whose connections are dropped (`listen_filter`).
"""

from __future__ import annotations

import contextlib
import ctypes
import select
import socket
import struct
import time
from collections.abc import Sequence
from typing import Any

from fogft.link.zenoh import settings, sockets

# Connections that may wait for Zenoh. It takes them at once, but for its rests.
WAITING_LIMIT = 4
RESTS_AFTER_S = 0.02

# Classic BPF (linux/filter.h): the code, where to jump if true and if not, and a constant.
Instruction = tuple[int, int, int, int]
RETURN = 0x06
_INSTRUCTION = struct.Struct("@HBBI")
_ATTACH_FILTER, _DETACH_FILTER, _ATTACH_CHOICE = 26, 27, 51  # SO_... of asm-generic/socket.h


class AcceptLoops:
    """Those at one port of this process. For one thread.

    Args:
        port: Where the replica listens; where no socket does, nothing is done.
    """

    def __init__(self, port: int) -> None:
        self._sockets = [one for _, one in sockets.listening(lambda address: address[1] == port)]
        self._chosen = 0
        self._waits_since: float | None = None
        if self._sockets:
            with contextlib.suppress(OSError):  # it stopped listening, or the kernel is too old
                self._sockets[0].listen(WAITING_LIMIT)
                self._move_spares()

    def _move_spares(self) -> None:
        first = self._sockets[0]
        first.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        for number, spare in sockets.listening(lambda address: address[0] == settings.SPARE_HOST):
            with sockets.unwatched(number) as unwatched:
                if unwatched:
                    _move(spare, first.getsockname())
                    self._sockets.append(spare)
                    self._choose(0)

    def _choose(self, number: int) -> None:
        _attach(self._sockets[0], _ATTACH_CHOICE, [(RETURN, 0, 0, number)])
        self._chosen = number

    def wait(self, timeout_s: float) -> bool:
        """Wait until a connection comes, but no longer than that; return whether one came."""
        if not self._sockets:
            time.sleep(timeout_s)
            return False
        waiting = select.poll()
        waiting.register(self._sockets[self._chosen], select.POLLIN)
        return bool(waiting.poll(timeout_s * 1e3))

    def look(self, now: float) -> None:
        """Have the next one take what comes, where the chosen one has rested for long."""
        if len(self._sockets) < 2 or not self.wait(0.0):
            self._waits_since = None
        elif self._waits_since is None:
            self._waits_since = now
        elif now - self._waits_since > RESTS_AFTER_S:
            rests, self._waits_since = self._sockets[self._chosen], None
            self._choose((self._chosen + 1) % len(self._sockets))
            _turn_away(rests)  # they come again, to the next one

    def turn_away(self) -> None:
        """End the connections that wait for Zenoh to take them."""
        for one in self._sockets:
            _turn_away(one)

    def judge(self, code: Sequence[Instruction]) -> None:
        """Have the kernel judge the first packet of each new connection; nothing for none."""
        for one in self._sockets:
            with contextlib.suppress(OSError):  # it stopped listening, or nothing judged so far
                if code:
                    _attach(one, _ATTACH_FILTER, code)
                else:
                    one.setsockopt(socket.SOL_SOCKET, _DETACH_FILTER, 0)

    def close(self) -> None:
        """Let go of the port: nothing of ours keeps it open."""
        for one in self._sockets:
            one.close()


def _move(listening: socket.socket, to: Any) -> None:
    """Have a socket listen elsewhere.

    Raises:
        OSError: It cannot be had there; it listens where it did, at another port.
    """
    own = listening.getsockname()
    # Once it has stopped listening, it forgets the port that the kernel chose: it has none again.
    listening.shutdown(socket.SHUT_RDWR)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        listening.bind(to)
    except OSError:
        listening.bind((own[0], 0))
        raise
    finally:
        listening.listen(WAITING_LIMIT)


def _attach(one: socket.socket, option: int, code: Sequence[Instruction]) -> None:
    held = ctypes.create_string_buffer(b"".join(_INSTRUCTION.pack(*line) for line in code))
    program = struct.pack("@HP", len(code), ctypes.addressof(held))
    one.setsockopt(socket.SOL_SOCKET, option, program)


def _turn_away(listening: socket.socket) -> None:
    listening.setblocking(False)  # as it is for Zenoh
    with contextlib.suppress(OSError):  # none waits any more
        while True:
            connection, _ = listening.accept()
            sockets.abort(connection)
            connection.close()
