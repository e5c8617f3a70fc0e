"""A replica with a good certificate that answers what nobody asked, as a process.

It lets robots in and answers probes as it should; then it sends to each of them, 20 times a
second, answers to random ids that become 63 MiB when they are unpacked. Its endpoint is printed;
it ends with its standard input.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
import zlib
from pathlib import Path

import zenoh

from fogft.link import frame
from fogft.link.port import Probe, ProbeAnswer
from fogft.link.zenoh.replica.listener import ZenohListener
from fogft.link.zenoh.replica.reply_streams import Stream
from fogft.model.credentials import CredentialPaths
from fogft.model.replica import ReplicaId
from tests.link.wire_pool import POOL_UID, SERVICE, keys

BOMB = zlib.compress(bytes(63 << 20), 9)
EVERY_S = 0.05


def throw(stream: Stream, stop: threading.Event) -> None:
    """Send bombs until told to stop, or until the robot has closed the connection."""
    while not stop.wait(EVERY_S):
        header = frame.encode_answer(os.urandom(4), os.urandom(16), packed=True)
        with contextlib.suppress(zenoh.ZError):
            stream.query.reply(stream.query.key_expr, BOMB, attachment=header)


def main() -> None:
    ca, certificate, key, slot = sys.argv[1:]
    files = CredentialPaths(Path(ca), Path(certificate), Path(key))
    listener = ZenohListener("127.0.0.1:0", files, ReplicaId(POOL_UID, int(slot), 1))
    stop, opened = threading.Event(), listener.streams.opened

    def throws(token: bytes, query: zenoh.Query, holder: str) -> list[tuple[bytes, zenoh.Query]]:
        ended = opened(token, query, holder)
        stream = listener.streams.of(token)
        threading.Thread(target=throw, args=(stream, stop), daemon=True).start()
        return ended

    listener.streams.opened = throws  # type: ignore[method-assign]

    def on_probe(probe: Probe) -> ProbeAnswer:
        return ProbeAnswer(
            slot=int(slot), generation=1, incarnation="hostile", ready=frozenset({SERVICE})
        )

    listener.serve(keys(int(slot)), lambda incoming: None, on_probe)
    print(json.dumps({"endpoint": listener.endpoint}), flush=True)
    sys.stdin.read()
    stop.set()
    listener.close()


if __name__ == "__main__":
    main()
