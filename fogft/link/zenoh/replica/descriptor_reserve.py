"""Descriptors that are kept for when strangers hold all others.

Without one, nothing tells whose the connections at the port are, no preemption notice is read and
no state is written. Zenoh takes of what is given back no more than wait at the port
(`listen_filter`).
"""

from __future__ import annotations

import os

SIZE = 32


class DescriptorReserve:
    """Some descriptors of this process, kept open. For one thread."""

    def __init__(self) -> None:
        self._kept: list[int] = []
        self.fill()

    def fill(self) -> bool:
        """Keep as many as there should be; False where no more can be had beside them."""
        try:
            while len(self._kept) < SIZE:
                self._kept.append(_open())
            os.close(_open())
        except OSError:
            return False
        return True

    def release(self) -> None:
        """Let the process use them."""
        while self._kept:
            os.close(self._kept.pop())


def _open() -> int:
    return os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
