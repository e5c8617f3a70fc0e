"""The barest way of a request to several replicas and back: what any proxy in Python can hope for.

    python -m tests.bench.bare replica FOLDER DOMAIN PORT
    python -m tests.bench.bare robot FOLDER DOMAIN PORT...

Serialised services at both ends, a Zenoh session and a sender thread a replica, a query for each
request, over mutual TLS; the first reply is the response. No ids, deadlines, probes, windows,
membership or counts: a robot that freezes, or a replica that never answers, breaks it. It has
services like those of the proxies that it is compared with, on the same machine and in the same
run, so that the comparison holds on any machine.
"""

from __future__ import annotations

import ctypes
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import zenoh
from zenoh import handlers

from fogft.model.choices import Speaks
from fogft.proxy import middleware
from fogft.ros import memory_tuning
from tests.bench.floor import configuration
from tests.bench.service import FLAG, MAP

KEYS = {FLAG: "bare/flag", MAP: "bare/map"}
_LIMIT_S = 10.0


def serve(folder: Path, domain: int, port: int) -> None:
    """Hand each query to the local service, and its response back."""
    node = middleware.join(Speaks.RCLPY, "bench_bare_replica", domain).node
    clients = {key: node.client(*service) for service, key in KEYS.items()}
    session = zenoh.open(configuration(folder, "replica", listen=[f"tls/127.0.0.1:{port}"]))
    kept = []
    for key, client in clients.items():

        def pass_on(query: Any, client: Any = client) -> None:
            def answer(payload: bytes) -> None:
                query.reply(query.key_expr, payload)
                query.drop()

            client.call(query.payload.to_bytes(), answer)

        kept.append(session.declare_queryable(key, handlers.Callback(pass_on, indirect=False)))
    _stay()


class Link:
    """One replica: a session, and the thread that asks on it."""

    def __init__(self, folder: Path, port: int) -> None:
        self._session = zenoh.open(
            configuration(folder, "robot", connect=[f"tls/127.0.0.1:{port}"])
        )
        self.asked: SimpleQueue[tuple[str, bytes, Any]] = SimpleQueue()
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while True:
            key, payload, answered = self.asked.get()
            self._session.get(
                key,
                handlers.Callback(answered, None, indirect=False),
                payload=payload,
                timeout=_LIMIT_S,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
            )


def ask(folder: Path, domain: int, ports: Sequence[int]) -> None:
    """Offer the services; ask every replica, and respond what comes first."""
    node = middleware.join(Speaks.RCLPY, "bench_bare_robot", domain).node
    links = [Link(folder, port) for port in ports]
    for (name, type_name), key in KEYS.items():
        ends: list[Any] = []

        def request(payload: bytes, handle: Any, ends: list[Any] = ends, key: str = key) -> None:
            first = threading.Lock()

            def answered(reply: Any) -> None:
                if reply.ok is not None and first.acquire(blocking=False):
                    ends[0].respond(handle, reply.ok.payload.to_bytes())

            for link in links:
                link.asked.put((key, payload, answered))

        ends.append(node.serve(name, type_name, request))
    _stay()


def _stay() -> None:
    print("ready", flush=True)
    threading.Event().wait()


def main() -> None:
    """Be one end, until the bench ends."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)
    middleware.prepare(Speaks.RCLPY)
    memory_tuning.tune()
    side, folder, domain, *ports = sys.argv[1:]
    if side == "replica":
        serve(Path(folder), int(domain), int(ports[0]))
    else:
        ask(Path(folder), int(domain), [int(port) for port in ports])


if __name__ == "__main__":
    main()
