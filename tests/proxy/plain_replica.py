"""A server proxy without ROS, as a process: its service echoes, and notes what it ran.

Argument: its `replica.yaml`, whose `run` is ``delay_s log``: each request that is passed on to the
service leaves its first eight bytes in that file. So a request that was run twice stands there
twice.
"""

from __future__ import annotations

import heapq
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping
from itertools import count
from pathlib import Path
from typing import Any

from fogft.link.zenoh.handshakes import HandshakeLog
from fogft.link.zenoh.replica.listener import ZenohListener
from fogft.process import stop_on_signal
from fogft.proxy.config import read_server
from fogft.proxy.replica.announcing import Presence
from fogft.proxy.replica.server import ServerProxy
from fogft.proxy.replica.supervisor import Supervisor
from fogft.records.record import RecordKind


class EchoNode:
    """Stands in for ROS: one client of every service, which answers what it was asked."""

    alive = True

    def __init__(self, delay_s: float, ran: Path) -> None:
        self._delay_s = delay_s
        self._ran = os.open(ran, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        self._tickets = count(1)
        self._due: list[tuple[float, int, bytes, Callable[[bytes], None]]] = []
        self._wake = threading.Condition()
        threading.Thread(target=self._answer, daemon=True).start()

    def serve(self, name: str, type_name: str, on_request: Any, on_burst: Any = None) -> Any:
        raise NotImplementedError

    def client(self, name: str, type_name: str) -> EchoNode:
        return self

    def look(self) -> None:
        """Nothing here depends on a clock."""

    def offered(self) -> Mapping[str, str]:
        return {}

    def is_known(self) -> bool:
        return True

    def available(self) -> bool:
        return True

    def servers(self) -> int:
        return 1

    def mismatch(self) -> str:
        return ""

    def call(self, payload: bytes, on_response: Callable[[bytes], None]) -> int:
        ticket = next(self._tickets)
        os.write(self._ran, payload[:8])
        with self._wake:
            heapq.heappush(
                self._due, (time.monotonic() + self._delay_s, ticket, payload, on_response)
            )
            self._wake.notify()
        return ticket

    def _answer(self) -> None:
        while True:
            with self._wake:
                while not self._due or self._due[0][0] > time.monotonic():
                    left = self._due[0][0] - time.monotonic() if self._due else None
                    self._wake.wait(left)
                _, _, payload, on_response = heapq.heappop(self._due)
            on_response(payload)

    def forget(self, ticket: int) -> None:
        pass

    def close(self) -> None:
        pass


def main() -> None:
    config = read_server(Path(sys.argv[1]))
    delay, ran = config.run.split()
    node = EchoNode(float(delay), Path(f"{ran}.{os.getpid()}"))
    stop = stop_on_signal()
    listener = ZenohListener(
        config.listen, config.credentials, config.id, handshakes=HandshakeLog()
    )
    command = Supervisor("exec sleep 86400", config.workdir, dict(os.environ))
    proxy = ServerProxy(config.id, config.services, listener, lambda: node, command)
    presence: Presence | None = None
    try:
        proxy.start()
        presence = Presence(config, proxy.endpoint)
        while not stop.wait(0.05):
            proxy.run_once()
            known = presence.look(proxy.ready, draining=proxy.draining)
            proxy.revoke(known.revoked)
            proxy.renew(known.of(RecordKind.LEASE))
    finally:
        if presence is not None:
            presence.close()
        proxy.close()


if __name__ == "__main__":
    main()
