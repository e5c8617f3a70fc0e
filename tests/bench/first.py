"""A client's first calls, and what pacing costs one that asks for nothing more.

`ours` is a serialised node, as proxies have, `direct` a plain rclpy one, and of `unpaced` the
second service sends each response at once. For its first calls a plain rclpy client is started
anew, as a process, for each time, before the one and the other in turns.
"""

from __future__ import annotations

import contextlib
import functools
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tests.bench.caller import Caller, milliseconds, payloads
from tests.bench.nodes.service import FLAG
from tests.bench.rig import Rig, free_domains
from tests.estimates import estimate_of_rounds, median
from tests.fakes.waiting import wait_for

SERVICES, TYPE = ("/bench_one", "/bench_two"), "std_srvs/srv/SetBool"
_LIMIT_S, _OPEN = 10.0, 20


def first(_folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Measure the time until services are found, and until the first calls are answered."""
    times = 3 if quick else 20
    rows = []
    with _servers("ours", "direct") as domains:
        for what in ("two clients at once", "killed with 20 calls open"):
            found: dict[str, list[list[float]]] = {kind: [] for kind in domains}
            for _ in range(times):
                for kind, domain in domains.items():
                    if what.startswith("killed"):
                        _start("die", kind, domain).wait()
                    words = _start("call", kind, domain).communicate()[0].split()
                    found[kind].append([float(word) for word in words[-2:]])  # after DDS's errors
            for kind, runs in found.items():
                ready, answered = zip(*runs, strict=True)
                row = {"what": what, "server": kind, "times": times}
                row |= {"ready_s": sorted(ready)[times // 2], "longest_ready_s": max(ready)}
                row |= {"median_s": median(answered)}
                in_time = [s for s in answered if s < _LIMIT_S]
                row |= {"longest_s": max(in_time, default=0.0), "lost": times - len(in_time)}
                rows.append(row)
    return rows


def lone(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Measure by how much pacing slows a lone caller of a node, and one of a replicated service.

    Calls of a paced and of an unpaced service of one node, and through one replica, take turns.
    """
    from fogft.ros.node import SerialisedNode

    rounds = 20 if quick else 100
    took: dict[str, list[float]] = {"ours": [], "unpaced": [], "proxied": []}  # medians of rounds
    with _servers("unpaced") as domains, Rig(folder, 1) as rig:
        node = SerialisedNode("bench_lone", domains["unpaced"])
        caller = Caller(rig.robot_domain, "bench_proxied")
        caller.wait()
        request = payloads()[FLAG[0]]
        calls = {k: _timed(node.client(s, TYPE)) for k, s in zip(took, SERVICES, strict=False)}
        calls["proxied"] = functools.partial(caller.call, FLAG[0], request)
        for number in range(1 + rounds):
            for kind in sorted(calls, reverse=bool(number % 2)):
                sample = milliseconds([calls[kind]() for _ in range(50)])
                if number:  # the first one warms up
                    took[kind].append(median(sample))
        node.close()
        caller.close()

    def slower(of: str) -> dict[str, float]:
        found = estimate_of_rounds(
            took,
            lambda s: 1 + (median(s["ours"]) - median(s["unpaced"])) / median(s[of]),
            random.Random(0),
            resamples=500,
        )
        return {"value": found.value, "low": found.low, "high": found.high}

    row: dict[str, Any] = {"what": "a lone caller", "calls": 50 * rounds}
    row |= {f"{kind}_ms": median(rounds_ms) for kind, rounds_ms in took.items()}
    return [row | {"node_ratio": slower("unpaced"), "proxied_ratio": slower("proxied")}]


def _timed(client: Any) -> Callable[[], float]:
    from rclpy.serialization import serialize_message
    from std_srvs.srv import SetBool

    request = bytes(serialize_message(SetBool.Request()))
    wait_for(client.available, 60.0)

    def call() -> float:
        answered = threading.Event()
        began = time.perf_counter()
        client.call(request, lambda _: answered.set())
        if not answered.wait(_LIMIT_S):
            raise TimeoutError(f"{SERVICES[0]} got no answer")
        return time.perf_counter() - began

    return call


@contextlib.contextmanager
def _servers(*kinds: str) -> Iterator[dict[str, int]]:
    """Serve in a domain for each kind; yield the domains."""
    domains = dict(zip(kinds, free_domains(len(kinds)), strict=True))
    servers = [_start("serve", kind, domain) for kind, domain in domains.items()]
    try:
        for server in servers:
            assert server.stdout is not None
            server.stdout.readline()
        yield domains
    finally:
        for server in servers:
            server.kill()
            server.wait()


def _start(role: str, kind: str, domain: int) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "tests.bench.first", role, kind, str(domain)]
    return subprocess.Popen(command, stdout=subprocess.PIPE)


def _serve(kind: str, domain: int) -> None:
    import rclpy
    from std_srvs.srv import SetBool

    if kind != "direct":
        from rclpy.serialization import serialize_message

        from fogft.ros import entities
        from fogft.ros.node import SerialisedNode

        answer = bytes(serialize_message(SetBool.Response(success=True)))
        ends: dict[str, Any] = {}
        node = SerialisedNode("bench_server", domain)
        for name in SERVICES:
            if kind == "unpaced" and ends:
                vars(entities)["Pacer"] = _Unpaced

            def respond(_: bytes, handle: Any, name: str = name) -> None:
                ends[name].respond(handle, answer)

            ends[name] = node.serve(name, TYPE, respond)
        print("ready", flush=True)
        signal.pause()
    rclpy.init(domain_id=domain)
    plain = rclpy.create_node("bench_server")
    for name in SERVICES:
        plain.create_service(SetBool, name, lambda _, response: response)
    print("ready", flush=True)
    rclpy.spin(plain)


class _Unpaced:
    """In place of `fogft.ros.pacing.pacer.Pacer`: each response leaves at once."""

    def __init__(self, send: Callable[[Any, bytes], None], *_: Any) -> None:
        self.respond = send

    def requested(self, handle: Any, *, together: bool = False) -> None:
        """Note nothing."""

    def close(self) -> None:
        """Nothing waits."""


def _call(role: str, domain: int) -> None:
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from std_srvs.srv import SetBool

    rclpy.init(domain_id=domain)
    node = rclpy.create_node("bench_client")
    began = time.monotonic()
    clients = [node.create_client(SetBool, name) for name in SERVICES]
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    wait_for(lambda: all(client.service_is_ready() for client in clients), 60.0, pause_s=0.002)
    ready = time.monotonic()
    if role == "die":
        clients[0].call_async(SetBool.Request())
        time.sleep(0.5)
        for _ in range(_OPEN):
            clients[0].call_async(SetBool.Request())
        os.kill(os.getpid(), signal.SIGKILL)
    calls = [client.call_async(SetBool.Request()) for client in clients]
    while not all(call.done() for call in calls) and time.monotonic() < ready + _LIMIT_S:
        time.sleep(0.001)
    print(ready - began, time.monotonic() - ready, flush=True)
    os._exit(0)


if __name__ == "__main__":
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    from fogft.ros import environment

    environment.prepare(os.environ)
    if sys.argv[1] == "serve":
        _serve(sys.argv[2], int(sys.argv[3]))
    _call(sys.argv[1], int(sys.argv[3]))
