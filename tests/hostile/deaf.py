"""A robot that is let in, reads nothing any more, and asks what makes others wait for it.

    python -m tests.hostile.deaf ENDPOINT CA CERTIFICATE KEY    says `deaf`, then asks until its end

A process of its own: a callback that blocks holds up all sessions of its process.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from pathlib import Path

import zenoh
from zenoh import handlers

from fogft.link import frame
from fogft.model import names
from fogft.model.credentials import CredentialPaths
from tests.hostile.robot import PROBE, greets, session_at, target
from tests.link.wire_pool import request_id

LARGE_ANSWERS = 8  # so many fill what the network and the replica keep of them
QUERIES = 20


def main() -> None:
    endpoint, *paths = sys.argv[1:]
    files, at = CredentialPaths(*map(Path, paths)), target(endpoint)
    reads_no_more = handlers.Callback(lambda reply: threading.Event().wait(), indirect=False)
    with session_at(at, files) as session:
        token = greets(session, files, at, reads_no_more)
        bare = frame.encode_greeting(frame.Greeting(token))
        origin = frame.origin("eve", token)
        for number in range(LARGE_ANSWERS):
            header = frame.encode_request(request_id(number), 60.0, origin)
            session.put(at.key, b"x", attachment=header)
        time.sleep(0.5)
        print("deaf", flush=True)
        for number in range(QUERIES):
            # What nobody answers, what is answered for all robots by one thread, and records.
            for name in ("nobody", names.PROBE, names.RECORDS, "*"):
                session.get(
                    names.slot_key(*at.place, name),
                    handlers.Callback(lambda reply: None, indirect=False),
                    payload=PROBE if number % 2 else bytes(1 << 16),  # well made or not
                    attachment=bare,
                    timeout=60.0,
                    congestion_control=zenoh.CongestionControl.BLOCK,
                )
            time.sleep(0.05)
        threading.Event().wait()


if __name__ == "__main__":
    try:
        main()
    finally:
        os._exit(0)
