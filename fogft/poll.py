"""Wait for a file descriptor of any number: `select.select` takes none above 1023."""

import select
import socket


def is_ready(
    file: int | socket.socket, timeout_s: float | None = 0.0, *, event: int | None = None
) -> bool:
    """Wait until a file, socket or pidfd is readable, or until `event`; return whether it is.

    Also true if reading would fail, for example from a closed file. None: no time limit.
    """
    waiting = select.poll()
    try:
        waiting.register(file, select.POLLIN if event is None else event)
    except ValueError:
        return True
    return bool(waiting.poll(None if timeout_s is None else timeout_s * 1e3))
