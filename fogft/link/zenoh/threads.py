"""Which threads are Zenoh's own: those that call our callbacks.

They must not send what might wait for room, since only they can make room. Zenoh has few of them,
and they live as long as the process.

Owns: that set. Not here: what a thread may do instead (`reply_queue`).
"""

from __future__ import annotations

import threading

_idents: set[int] = set()


def note() -> None:
    """Note that this thread is Zenoh's. Called by every callback that may lead to a reply."""
    _idents.add(threading.get_ident())


def is_this() -> bool:
    """Whether this thread is one of Zenoh's."""
    return threading.get_ident() in _idents
