"""A replica for tests: answers each request with its own bytes, after a while if told.

``noise:N`` is answered with N bytes that do not shrink, ``text:N`` with N that do.
Arguments come as JSON in the command line, commands as JSON lines on stdin; each command is
answered with the listener's counters.
"""

from __future__ import annotations

import heapq
import json
import random
import sys
import threading
import time
from functools import lru_cache, partial
from pathlib import Path

from fogft import disk
from fogft.cloud import notice
from fogft.link.port import Incoming, Probe, ProbeAnswer
from fogft.link.zenoh import settings as zenoh_settings
from fogft.link.zenoh.handshakes import HandshakeLog
from fogft.link.zenoh.replica.listener import ZenohListener
from fogft.link.zenoh.settings import LinkSettings
from fogft.model.credentials import CredentialPaths
from fogft.model.refusal import Refusal
from fogft.model.replica import ReplicaId
from fogft.records import cache
from tests.link.wire_pool import POOL_UID, SERVICE, keys

TEXT = b"the quick brown fox jumps over the lazy dog "


@lru_cache
def content(asked: bytes) -> bytes:
    """Return what a request such as ``noise:100`` asks for."""
    kind, _, size = asked.partition(b":")
    if kind == b"noise":
        return random.Random(1).randbytes(int(size))
    return (TEXT * (int(size) // len(TEXT) + 1))[: int(size)]


class Service(threading.Thread):
    """Answers after `delay_s`, in a thread of its own."""

    def __init__(self, delay_s: float, reply_bytes: int) -> None:
        super().__init__(daemon=True)
        self.delay_s = delay_s
        self._reply_bytes = reply_bytes
        self._due: list[tuple[float, int, Incoming]] = []
        self._count = 0
        self._wake = threading.Condition()
        self.in_flight = 0

    def request(self, incoming: Incoming) -> None:
        if self.delay_s <= 0:
            self._answer(incoming)
            return
        with self._wake:
            self._count += 1
            heapq.heappush(self._due, (time.monotonic() + self.delay_s, self._count, incoming))
            self._wake.notify()

    def run(self) -> None:
        while True:
            with self._wake:
                while not self._due or self._due[0][0] > time.monotonic():
                    left = self._due[0][0] - time.monotonic() if self._due else None
                    self._wake.wait(left)
                incoming = heapq.heappop(self._due)[2]
            self._answer(incoming)

    def _answer(self, incoming: Incoming) -> None:
        if incoming.payload.startswith(b"refuse:"):
            incoming.refuse(Refusal(incoming.payload[7:].decode()))
        elif incoming.payload == b"ignore":
            pass
        elif incoming.payload == b"who":
            incoming.reply(incoming.robot.encode())
        elif incoming.payload.startswith((b"noise:", b"text:")):
            incoming.reply(content(incoming.payload))
        elif self._reply_bytes >= 0:
            incoming.reply(bytes(self._reply_bytes))
        else:
            incoming.reply(incoming.payload)


def noted(state_file: Path, one: notice.Notice) -> None:
    """Write down that a preemption notice was read."""
    disk.write_json(state_file, one.kind.value)


def main() -> None:
    given = json.loads(sys.argv[1])
    files = CredentialPaths(Path(given["ca"]), Path(given["certificate"]), Path(given["key"]))
    id = ReplicaId(POOL_UID, given["slot"], given["generation"])
    settings = LinkSettings(**given["settings"])
    zenoh_settings.SESSIONS_LIMIT = given["sessions"]
    listener = ZenohListener(
        given["endpoint"], files, id, settings=settings, handshakes=HandshakeLog()
    )
    listener.take_records(cache.read(Path(given["records"])) if given["records"] else ())
    service = Service(given["delay_s"], given["reply_bytes"])
    service.start()
    state = {"ready": [SERVICE], "draining": False}

    def on_probe(probe: Probe) -> ProbeAnswer:
        slot, generation = given["claims"]
        return ProbeAnswer(
            slot=slot,
            generation=generation,
            incarnation="test",
            ready=frozenset(state["ready"]),
            draining=bool(state["draining"]),
        )

    listener.serve(keys(given["slot"]), service.request, on_probe)
    print(json.dumps({"endpoint": listener.endpoint}), flush=True)
    for line in sys.stdin:
        command = json.loads(line)
        service.delay_s = command.pop("delay_s", service.delay_s)
        listener.revoke(command.pop("revoke", ()))
        for source, state_file in command.pop("watch", {}).items():
            notice.Watch(f"file:{source}", partial(noted, Path(state_file)))
        state.update(command)
        lease = listener.lease()
        told = {"lease": 0 if lease is None else lease.record.sequence}
        print(json.dumps({**listener.counters(), **told}), flush=True)
    listener.close()


if __name__ == "__main__":
    main()
