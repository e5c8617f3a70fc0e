"""A client proxy without ROS, as a process: its callers are commands on standard input.

Each command is a JSON line and is answered by one:
``{"ask": N, "bytes": B, "service": NAME}`` asks N requests of B bytes at once;
``{}`` tells how many were asked and rightly answered, what was wrong, how long each took that was
answered since the last command, and the proxy's report.
Arguments: its configuration, and the number of its first request.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fogft.disk import Watched
from fogft.errors import RosError
from fogft.proxy.config import read_client
from fogft.proxy.robot.client import ClientProxy
from fogft.proxy.robot.dispatcher import Dispatcher
from fogft.proxy.robot.following import Following
from fogft.proxy.robot.process import make_dialer, try_step
from tests.fakes.waiting import wait_for


class Callers:
    """Stands in for ROS: asks, and checks that each answer is its own request's."""

    alive = True

    def __init__(self, first: int = 1) -> None:
        self._next = first
        self._took: list[tuple[int, float]] = []
        self._ask: dict[str, Callable[[bytes, Any], None]] = {}
        self._lock = threading.Lock()
        self._open: dict[int, bytes] = {}
        self.asked = self.right = 0
        self.wrong: list[int] = []
        self.slowest_s = 0.0
        self._began: dict[int, float] = {}

    def serve(
        self,
        name: str,
        type_name: str,
        on_request: Callable[[bytes, Any], None],
        on_burst: Any = None,
    ) -> Callers:
        self._ask[name] = on_request
        return self

    def client(self, name: str, type_name: str) -> Any:
        raise RosError("there is no ROS here")

    def mismatch(self) -> str:
        return ""

    def close(self) -> None:
        pass

    def ask(self, count: int, size: int, service: str) -> None:
        wait_for(lambda: service in self._ask, 60.0, "a replica to be ready: then it is offered")
        for _ in range(count):
            self.asked += 1
            number, self._next = self._next, self._next + 1
            payload = number.to_bytes(8, "big") * max(size // 8, 1)
            self._open[number] = payload
            self._began[number] = time.monotonic()
            self._ask[service](payload, number)

    def respond(self, handle: Any, payload: bytes) -> None:
        with self._lock:
            expected = self._open.pop(handle, None)
            took_s = time.monotonic() - self._began.pop(handle, 0.0)
            self.slowest_s = max(self.slowest_s, took_s)
            self._took.append((handle, round(took_s, 6)))
            if expected == payload:
                self.right += 1
            else:
                self.wrong.append(handle)

    def report(self) -> dict[str, Any]:
        with self._lock:
            took, self._took = self._took, []
        return {
            "took": took,
            "next": self._next,
            "services": sorted(self._ask),
            "asked": self.asked,
            "right": self.right,
            "wrong": self.wrong,
            "slowest_s": self.slowest_s,
        }


def main() -> None:
    config = read_client(Path(sys.argv[1]))
    callers = Callers(int(sys.argv[2]) if len(sys.argv) > 2 else 1)
    dialer = make_dialer(config)
    proxy = ClientProxy(
        config.pool_uid,
        callers,
        dialer,
        lambda spec, respond, wake: Dispatcher(spec, respond, wake=wake),
    )
    proxy.serve(config.services)
    following = Following(config)
    certificate = Watched(config.credentials.certificate)
    certificate.changed()

    def follow() -> None:
        membership = following.look()
        if membership is not None:
            proxy.follow(membership)

    def keep() -> None:
        while True:
            proxy.run_once()
            try_step(follow, config.membership)
            if certificate.changed():
                proxy.renew()
                following.renew()

    threading.Thread(target=keep, daemon=True).start()
    for line in sys.stdin:
        command = json.loads(line)
        if "ask" in command:
            service = command.get("service", config.services[0].name)
            callers.ask(command["ask"], command.get("bytes", 8), service)
        report = {**proxy.report(), **following.report()}
        print(json.dumps({**callers.report(), "report": report}), flush=True)


if __name__ == "__main__":
    main()
