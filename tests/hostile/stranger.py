"""A stranger as a process: opens many connections to a port, and says what makes them costly.

It has no certificate. ``junk`` sends what is no TLS, ``hello`` a good first message of TLS and
then nothing, ``silent`` nothing at all, ``leave`` what ``hello`` does, and hangs up. Prints
``ready``, waits for a line, floods, and prints how many connections it tried, and were taken.
"""

from __future__ import annotations

import contextlib
import random
import selectors
import socket
import ssl
import sys
import time

_AT_ONCE = 600
_HELD_S = 30.0  # then it hangs up


def hello() -> bytes:
    """Return the first message of a TLS client."""
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with contextlib.suppress(ssl.SSLWantReadError):
        context.wrap_bio(incoming, outgoing).do_handshake()
    return outgoing.read()


SAYS = {"junk": random.Random(1).randbytes(200), "hello": hello(), "silent": b"", "leave": hello()}


def flood(endpoint: str, source: str, kind: str, count: int, lasts_s: float) -> tuple[int, int]:
    """Open `count` connections, as fast as may be; return how many were tried, and taken."""
    host, _, port = endpoint.rpartition(":")
    waiting, held = selectors.DefaultSelector(), list[tuple[float, socket.socket]]()
    tried = taken = 0
    end = time.monotonic() + lasts_s
    while time.monotonic() < end:
        while tried < count and len(waiting.get_map()) < _AT_ONCE:
            one = socket.socket()
            one.setblocking(False)
            one.bind((source, 0))
            one.connect_ex((host, int(port)))
            waiting.register(one, selectors.EVENT_WRITE)
            tried += 1
        for key, _ in waiting.select(0.01):
            one = key.fileobj  # type: ignore[assignment]
            waiting.unregister(one)
            try:
                one.send(SAYS[kind])
                taken += 1
            except OSError:
                one.close()
                continue
            if kind == "leave":
                one.close()
            else:
                held.append((time.monotonic() + _HELD_S, one))
        while held and held[0][0] < time.monotonic():
            held.pop(0)[1].close()
    return tried, taken


def main() -> None:
    endpoint, source, kind, count, lasts_s = sys.argv[1:]
    print("ready", flush=True)
    sys.stdin.readline()
    print(*flood(endpoint, source, kind, int(count), float(lasts_s)), flush=True)


if __name__ == "__main__":
    main()
