"""A client's first calls: two new clients of one node at once, and a node killed with calls open.

`ours` is a serialised node, as proxies have, `direct` a plain rclpy one. A plain rclpy client is
started anew, as a process, for each time, before the one and the other in turns.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from tests.bench.rig import free_domains

SERVICES = ("/bench_one", "/bench_two")
_LIMIT_S, _OPEN = 10.0, 20


def first(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Measure the time until services are found, and until the first calls are answered."""
    times = 3 if quick else 20
    rows = []
    with (folder / "log").open("wb") as log:
        kinds = dict(zip(("ours", "direct"), free_domains(2), strict=True))
        servers = [_start("serve", kind, domain, log) for kind, domain in kinds.items()]
        try:
            for server in servers:
                assert server.stdout is not None
                server.stdout.readline()
            for what in ("two clients at once", "killed with 20 calls open"):
                found: dict[str, list[list[float]]] = {kind: [] for kind in kinds}
                for _ in range(times):
                    for kind, domain in kinds.items():
                        if what.startswith("killed"):
                            _start("die", kind, domain, log).wait()
                        text = _start("call", kind, domain, log).communicate()[0]
                        found[kind].append([float(word) for word in text.split()])
                for kind, runs in found.items():
                    ready, answered = zip(*runs, strict=True)
                    row = {"what": what, "server": kind, "times": times}
                    row |= {"ready_s": sorted(ready)[times // 2], "longest_ready_s": max(ready)}
                    in_time = [s for s in answered if s < _LIMIT_S]
                    row |= {"longest_s": max(in_time, default=0.0), "lost": times - len(in_time)}
                    rows.append(row)
        finally:
            for server in servers:
                server.kill()
                server.wait()
    return rows


def _start(role: str, kind: str, domain: int, log: Any) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "tests.bench.first", role, kind, str(domain)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log)


def _serve(kind: str, domain: int) -> None:
    import rclpy
    from std_srvs.srv import SetBool

    if kind == "ours":
        from rclpy.serialization import serialize_message

        from fogft.ros.node import SerialisedNode

        answer, ends = bytes(serialize_message(SetBool.Response(success=True))), {}
        node = SerialisedNode("bench_server", domain)
        for name in SERVICES:
            ends[name] = node.serve(
                name,
                "std_srvs/srv/SetBool",
                lambda _, handle, name=name: ends[name].respond(handle, answer),
            )
        print("ready", flush=True)
        signal.pause()
    rclpy.init(domain_id=domain)
    plain = rclpy.create_node("bench_server")
    for name in SERVICES:
        plain.create_service(SetBool, name, lambda _, response: response)
    print("ready", flush=True)
    rclpy.spin(plain)


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
    while not all(client.service_is_ready() for client in clients):
        time.sleep(0.002)
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
