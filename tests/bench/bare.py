"""The barest way of a request to several replicas and back: what any proxy in Python can hope for.

    python -m tests.bench.bare replica FOLDER DOMAIN PORT
    python -m tests.bench.bare robot FOLDER DOMAIN PORT...

Serialised services at both ends and a Zenoh session a replica, over mutual TLS. A request is one
published message, sent by the thread that took it; its answer is a reply to one query that stays
open; the first is the response. Zenoh's threads are few and keep their Python thread states, as
the proxies' do. No deadlines, probes, windows, membership or counts: a robot that freezes, or a
replica that never answers, breaks it. It has services like those of the proxies that it is
compared with, on the same machine and in the same run, so that the comparison holds on any machine.
"""

from __future__ import annotations

import ctypes
import itertools
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import zenoh
from zenoh import handlers

from fogft.link.zenoh import threads
from fogft.link.zenoh.settings import ask_for_threads
from fogft.model.choices import Speaks
from fogft.proxy import middleware
from fogft.ros import memory_tuning
from tests.bench.floor import configuration
from tests.bench.nodes.service import FLAG, MAP
from tests.fakes.waiting import wait_for

KEYS = {FLAG: "bare/flag", MAP: "bare/map"}
_ANSWERS = "bare/answers"
_LIMIT_S = 1e6
_BLOCK = zenoh.CongestionControl.BLOCK


def serve(folder: Path, domain: int, port: int) -> None:
    """Hand each message to the local service, and its response back."""
    node = middleware.join(Speaks.RCLPY, "bench_bare_replica", domain).node
    clients = {key: node.client(*service) for service, key in KEYS.items()}
    session = zenoh.open(configuration(folder, "replica", listen=[f"tls/127.0.0.1:{port}"]))
    queries: list[Any] = []
    kept: list[Any] = [session.declare_queryable(_ANSWERS, _on_zenoh(queries.append))]
    for key, client in clients.items():

        def pass_on(sample: Any, client: Any = client) -> None:
            number, query = sample.attachment, queries[0]

            def answer(payload: bytes) -> None:
                query.reply(_ANSWERS, payload, attachment=number)

            client.call(sample.payload.to_bytes(), answer)

        kept.append(session.declare_subscriber(key, _on_zenoh(pass_on)))
    _stay()


def ask(folder: Path, domain: int, ports: Sequence[int]) -> None:
    """Offer the services; ask every replica, and respond what comes first."""
    node = middleware.join(Speaks.RCLPY, "bench_bare_robot", domain).node
    waiting: dict[bytes, tuple[Any, Any]] = {}
    numbers = itertools.count()

    def answered(reply: Any) -> None:
        end, handle = waiting.pop(reply.ok.attachment.to_bytes(), (None, None))
        if end is not None:
            end.respond(handle, reply.ok.payload.to_bytes())

    sessions = [
        zenoh.open(configuration(folder, "robot", connect=[f"tls/127.0.0.1:{port}"]))
        for port in ports
    ]
    publishers = {
        key: [one.declare_publisher(key, congestion_control=_BLOCK) for one in sessions]
        for key in KEYS.values()
    }
    every = [one for many in publishers.values() for one in many]
    wait_for(lambda: all(one.matching_status.matching for one in every), 60.0)
    for session in sessions:
        session.get(
            _ANSWERS,
            _on_zenoh(answered),
            timeout=_LIMIT_S,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
    for (name, type_name), key in KEYS.items():
        ends: list[Any] = []

        def request(payload: bytes, handle: Any, ends: list[Any] = ends, key: str = key) -> None:
            number = next(numbers).to_bytes(8, "big")
            waiting[number] = ends[0], handle
            for publisher in publishers[key]:
                publisher.put(payload, attachment=number)

        ends.append(node.serve(name, type_name, request))
    _stay()


def _on_zenoh(call: Any) -> Any:
    """Return what Zenoh's own thread calls."""

    def called(one: Any) -> None:
        threads.note()
        call(one)

    return handlers.Callback(called, indirect=False)


def _stay() -> None:
    print("ready", flush=True)
    threading.Event().wait()


def main() -> None:
    """Be one end, until the bench ends."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)
    middleware.prepare(Speaks.RCLPY)
    ask_for_threads()
    memory_tuning.tune()
    side, folder, domain, *ports = sys.argv[1:]
    if side == "replica":
        serve(Path(folder), int(domain), int(ports[0]))
    else:
        ask(Path(folder), int(domain), [int(port) for port in ports])


if __name__ == "__main__":
    main()
