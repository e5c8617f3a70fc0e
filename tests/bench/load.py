"""Services that do one thing at a time, from idle to full, beside a plain load balancer.

Three replicas of a serial service; callers that do not wait (open loop). `haproxy` is HAProxy
with ``leastconn`` before three HTTP servers that sleep as the service does: what a user would
take who gives up ROS, replacement and everything else.
"""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tests.bench.caller import Caller, milliseconds, payloads
from tests.bench.machine import cpu_s, family
from tests.bench.nodes.service import FLAG
from tests.bench.rig import Rig
from tests.estimates import percentile
from tests.ports import free_ports

REPLICAS = 3
MEDIAN_S, TIMEOUT_S = 0.02, 2.0
# Name: sigma, share of requests that stall, for how long.
SERVICES = {"constant": (0.0, 0.0, 0.0), "stalling": (0.3, 0.01, 0.2)}
Ask = Callable[[Callable[[], None]], None]


def load(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Compare the policies and HAProxy at several loads, system after system at each load.

    Load is a share of what three can do. Latencies are of what was answered within 2 s; all
    else has failed. Copies are attempts that reached a service.
    """
    loads = (0.1, 0.5) if quick else (0.1, 0.3, 0.5, 0.7, 0.9)
    seconds = 6.0 if quick else 20.0
    rows = []
    for name, (sigma, stalled, stall_s) in SERVICES.items():
        below = folder / name
        below.mkdir()
        arguments = [MEDIAN_S, sigma, stalled, stall_s, 1]
        words = " ".join(map(str, arguments))
        with contextlib.ExitStack() as stack:
            policy = {"timeout_s": TIMEOUT_S}
            rig = stack.enter_context(Rig(below, REPLICAS, services=[words] * 3, policy=policy))
            caller = Caller(rig.robot_domain, f"bench_load_{name}")
            stack.callback(caller.close)
            rig.wait_ready(range(REPLICAS))
            caller.wait()
            peer = None
            if shutil.which("haproxy"):
                peer = stack.enter_context(haproxy(below, words))
            for share in loads:
                for system in ("auto", "failover", "all", "haproxy"):
                    if system != "haproxy":
                        row = _of_rig(rig, caller, system, share, seconds, mean_s(name))
                    elif peer is not None:
                        row = peer.row(share, seconds, mean_s(name))
                    else:
                        continue
                    rows.append({"service": name, "load": share, "system": system, **row})
    return rows


def idle(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Measure what the proxies of a pool of three use when nobody asks."""
    seconds = 15.0 if quick else 60.0
    with Rig(folder, REPLICAS) as rig:
        time.sleep(5.0)
        proxies = [rig.proxy.pid, *(replica.process.pid for replica in rig.replicas)]
        before = [cpu_s(pid) for pid in proxies]
        time.sleep(seconds)
        robot, *replicas = (
            (cpu_s(pid) - used) * 1000 / seconds for pid, used in zip(proxies, before, strict=True)
        )
    row = {"robot_ms_per_s": robot, "replica_ms_per_s": sum(replicas) / REPLICAS}
    return [{"replicas": REPLICAS, **row, "pool_ms_per_s": robot + sum(replicas)}]


def _of_rig(
    rig: Rig, caller: Caller, policy: str, share: float, seconds: float, takes_s: float
) -> dict[str, Any]:
    rig.change(hedging=policy, timeout_s=TIMEOUT_S)
    before = rig.report(after=time.time())["services"][FLAG[0]]
    proxies = [rig.proxy.pid, *(replica.process.pid for replica in rig.replicas)]
    used = sum(map(cpu_s, proxies))
    row = _row(*offer(asking(caller), share, seconds, takes_s))
    row["cpu_ms_per_request"] = (sum(map(cpu_s, proxies)) - used) * 1000 / row["requests"]
    after = rig.report(after=time.time())["services"][FLAG[0]]
    row["copies"] = (after["sent"] - before["sent"]) / row["requests"]
    return row


def asking(caller: Caller) -> Ask:
    """Return what sends a request of a few bytes through ROS."""
    payload = payloads()[FLAG[0]]
    return lambda answered: caller.ask(FLAG[0], payload, answered)


def mean_s(service: str, median_s: float = MEDIAN_S) -> float:
    """Return how long a service takes for a request on average."""
    sigma, stalled, stall_s = SERVICES[service]
    return median_s * math.exp(sigma**2 / 2) + stalled * stall_s


def offer(
    ask: Ask, share: float, seconds: float, takes_s: float = MEDIAN_S
) -> tuple[int, list[float]]:
    """Ask at random moments without waiting, so often as a share of what all replicas can do.

    Returns:
        How many requests there were, and how many seconds each took that was answered in time.
    """
    per_s = share * REPLICAS / takes_s
    source, took = random.Random(1), list[float]()
    count, at = int(per_s * seconds), time.perf_counter()
    for _ in range(count):
        at += source.expovariate(per_s)
        time.sleep(max(0.0, at - time.perf_counter()))
        began = time.perf_counter()
        ask(lambda began=began: took.append(time.perf_counter() - began))
    time.sleep(TIMEOUT_S + 0.5)
    return count, [s for s in took if s <= TIMEOUT_S]


def _row(count: int, answered: list[float]) -> dict[str, Any]:
    ms = milliseconds(answered)
    return {
        "requests": count,
        "failed": count - len(answered),
        "p50_ms": percentile(ms, 50),
        "p99_ms": percentile(ms, 99),
    }


class Balanced:
    """HTTP requests through a load balancer, each in a thread, over connections that stay open.

    Args:
        port: Where it listens.
        pid: Its process; those below it are counted, too.
        folder: Where servers note their deaths.
    """

    def __init__(self, port: int, pid: int, folder: Path) -> None:
        self._port = port
        self._pid = pid
        self._folder = folder
        self._idle: list[http.client.HTTPConnection] = []

    def row(self, share: float, seconds: float, takes_s: float) -> dict[str, Any]:
        """Return what became of requests at a load."""
        used = self.used_s()
        row = _row(*offer(self.ask, share, seconds, takes_s))
        row["cpu_ms_per_request"] = (self.used_s() - used) * 1000 / row["requests"]
        return {**row, "copies": 1.0}

    def used_s(self) -> float:
        """Return the processor time that it has used."""
        return sum(map(cpu_s, family(self._pid)))

    def ask(self, answered: Callable[[], None]) -> None:
        """Send a request, and wait for nothing."""
        threading.Thread(target=self._ask, args=(b"1", answered), daemon=True).start()

    def poison(self) -> None:
        """Send a request that ends the server which gets it."""
        threading.Thread(target=self._ask, args=(b"0", lambda: None), daemon=True).start()

    def deaths(self) -> int:
        """Return how many servers have died."""
        return sum(len(file.read_bytes()) for file in self._folder.glob("deaths-*"))

    def _ask(self, body: bytes, answered: Callable[[], None]) -> None:
        with contextlib.suppress(OSError, http.client.HTTPException):
            try:
                connection = self._idle.pop()
            except IndexError:
                connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=10)
            connection.request("POST", "/", body)
            response = connection.getresponse()
            response.read()
            self._idle.append(connection)
            if response.status == 200:
                answered()


@contextlib.contextmanager
def haproxy(folder: Path, words: str, balance: str = "leastconn") -> Iterator[Balanced]:
    """Start HAProxy before HTTP servers, which are started again when they die."""
    front, *backs = free_ports(1 + REPLICAS)
    servers = "".join(f"  server s{n} 127.0.0.1:{port}\n" for n, port in enumerate(backs))
    config = folder / "haproxy.cfg"
    config.write_text(
        "defaults\n  mode http\n  timeout connect 5s\n  timeout client 60s\n  timeout server 60s\n"
        f"frontend in\n  bind 127.0.0.1:{front}\n  default_backend out\n"
        f"backend out\n  balance {balance}\n{servers}"
    )
    module = "tests.bench.load"
    processes = [
        subprocess.Popen(
            [
                "bash",
                "-c",
                f"while :; do {sys.executable} -m {module} {port} {words}; "
                f"printf . >>{folder}/deaths-{port}; done",
            ],
            start_new_session=True,
        )
        for port in backs
    ]
    command = ["haproxy", "-f", str(config), "-db", "-q"]
    processes.append(subprocess.Popen(command, start_new_session=True))
    try:
        time.sleep(1.5)
        yield Balanced(front, processes[-1].pid, folder)
    finally:
        for process in processes:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@contextlib.contextmanager
def ray_serve(folder: Path, words: str, python: str) -> Iterator[Balanced]:
    """Start Ray Serve with three replicas, by a Python that has it."""
    [port] = free_ports(1)
    script = str(Path(__file__).parent / "nodes" / "ray_serve.py")
    environ = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    process = subprocess.Popen(
        [python, script, str(port), str(folder), *words.split()],
        env=environ,
        start_new_session=True,
        stdout=subprocess.PIPE,
    )
    try:
        assert process.stdout is not None
        if process.stdout.readline() != b"ready\n":
            raise RuntimeError(f"Ray Serve has not started: status {process.wait()}")
        yield Balanced(port, process.pid, folder)
    finally:
        for pid in family(process.pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        process.wait()


async def serve(port: int, median_s: float, sigma: float, stalled: float, stall_s: float) -> None:
    """Answer HTTP requests one after the other, each after a drawn time."""
    one_at_a_time, source = asyncio.Lock(), random.Random()

    async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                head = await reader.readuntil(b"\r\n\r\n")
                length = next(
                    int(line.split(b":")[1])
                    for line in head.split(b"\r\n")
                    if line.lower().startswith(b"content-length")
                )
                if await reader.readexactly(length) == b"0":
                    os._exit(1)
                async with one_at_a_time:
                    seconds = median_s * source.lognormvariate(0.0, sigma)
                    seconds += stall_s if source.random() < stalled else 0.0
                    await asyncio.sleep(seconds)
                writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: 1\r\n\r\n1")
                await writer.drain()
        writer.close()

    server = await asyncio.start_server(connected, "127.0.0.1", port)
    await server.serve_forever()


if __name__ == "__main__":
    at, *times = sys.argv[1:6]
    asyncio.run(serve(int(at), *map(float, times)))
