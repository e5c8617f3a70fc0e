"""Zenoh's threads, and our threads inside Zenoh when the process exits.

Zenoh's threads, which call our callbacks, must not make a send that could wait for room: only they
can make room. Each keeps its Python thread state, else every callback would create and destroy one.

A daemon thread that returns from Zenoh while the interpreter shuts down aborts the process
(SIGABRT: Rust frames cannot be unwound). So the process waits at exit for threads that close a
session, but not for long: with a frozen peer, closing takes ten seconds.
"""

import atexit
import ctypes
import logging
import threading
import time
import weakref
from typing import Any

import zenoh

from fogft.process import on_thread

log = logging.getLogger(__name__)

idents: set[int] = set()  # Zenoh's threads, by `threading.get_ident`


def note() -> None:
    """Mark this thread as Zenoh's. Called by each callback for requests and answers."""
    ident = threading.get_ident()
    if ident not in idents:
        idents.add(ident)
        ctypes.pythonapi.PyGILState_Ensure()  # never released


WAIT_S = 2.0
_leaving: weakref.WeakSet[threading.Thread] = weakref.WeakSet()
join_at_exit = _leaving.add  # make the process wait for a thread that is about to end


def close_session(session: Any) -> None:
    """Close a Zenoh session. May take 10 s, as Zenoh waits for a frozen peer."""
    try:
        session.close()
    except zenoh.ZError as error:  # the peer has data in flight
        log.debug("session_closed_late reason=%r", str(error))


def close_aside(session: Any, name: str, wait_s: float = 0.0) -> None:
    """Close a Zenoh session, if possible on a thread that the process waits for at exit."""
    try:
        closer = on_thread(close_session, session, name=name)
    except OSError:
        close_session(session)
    else:
        join_at_exit(closer)
        closer.join(wait_s)


@atexit.register
def _wait() -> None:
    end = time.monotonic() + WAIT_S
    for thread in list(_leaving):
        if thread is not threading.current_thread():
            thread.join(max(0.0, end - time.monotonic()))
