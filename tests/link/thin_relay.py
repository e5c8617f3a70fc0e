"""A TCP relay on loopback that passes so many bytes a second each way, and may stop doing so."""

from __future__ import annotations

import contextlib
import random
import socket
import threading
import time

_CHUNK_BYTES = 4096
# Small, so that what waits does so at the sender; above half of loopback's segments, or TCP
# itself would pause.
_BUFFER_BYTES = 32 << 10


class ThinRelay:
    """Passes bytes on to a target, slowly.

    Args:
        target: ``host:port``.
        bytes_per_s: Each way, for all connections together; may be changed.
        host: Where it listens.

    Attributes:
        bytes_per_s: As given.
        delay_s: What passes is held up by so long.
        jitter_s: And by up to so much more.
        endpoint: ``host:port`` where it listens.
        open: Clear it, and nothing passes until it is set again.
        passed_bytes: What has passed, both ways together.
    """

    def __init__(
        self, target: str, bytes_per_s: float = float("inf"), *, host: str = "127.0.0.1"
    ) -> None:
        far, _, port = target.rpartition(":")
        self._target = (far, int(port))
        self.bytes_per_s = bytes_per_s
        self.delay_s = self.jitter_s = 0.0
        self._chance = random.Random(1)
        self._server = socket.socket()
        # Small buffers, set before listening: what waits shall wait at the sender.
        self._server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        self._server.bind((host, 0))
        self._server.listen()
        self._ends: list[socket.socket] = [self._server]
        self.endpoint = f"{host}:{self._server.getsockname()[1]}"
        self.open = threading.Event()
        self.open.set()
        self.passed_bytes = 0
        self._next = {"up": 0.0, "down": 0.0}
        self._lock = threading.Lock()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._server.accept()
            except OSError:
                return  # closed
            # Nobody waits behind one whose packets the target drops.
            threading.Thread(target=self._join, args=(near,), daemon=True).start()

    def _join(self, near: socket.socket) -> None:
        far = socket.socket()
        far.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        try:
            far.connect(self._target)
        except OSError:  # nobody listens there, now
            near.close()
            far.close()
            return
        for end in (near, far):
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
        self._ends += [near, far]
        for source, sink, way in ((near, far, "up"), (far, near, "down")):
            threading.Thread(target=self._pass, args=(source, sink, way), daemon=True).start()

    def _pass(self, source: socket.socket, sink: socket.socket, way: str) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(_CHUNK_BYTES):
                with self._lock:  # a turn on the line
                    begin = max(self._next[way], time.monotonic())
                    self._next[way] = begin + len(data) / self.bytes_per_s
                    self.passed_bytes += len(data)
                late_s = self.delay_s + self._chance.uniform(0.0, self.jitter_s)
                time.sleep(max(0.0, self._next[way] - time.monotonic()) + late_s)
                self.open.wait()
                sink.sendall(data)
        for end in (source, sink):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self.open.set()
        for end in self._ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
