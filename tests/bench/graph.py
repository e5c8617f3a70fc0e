"""Topics, actions, and bursts of requests: what passing them costs, and that none is lost."""

from __future__ import annotations

import gc
import importlib.util
import os
import random
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.bench.caller import CALL_LIMIT_S, Caller, milliseconds, payloads
from tests.bench.floor import Floor
from tests.bench.rig import Rig
from tests.bench.service import ACTION_SERVICES, FLAG, TOPICS
from tests.estimates import estimate_of_rounds, median, overhead_ratio, percentile

_WARM_UP = 30
_LARGE = 640 * 480 * 3
_BURST = 100
_READY_S = 60.0


class Graph:
    """Says, hears, and sends goals in one ROS domain."""

    def __init__(self, domain_id: int, name: str) -> None:
        from fogft.model.topic import Quality
        from fogft.ros.node import SerialisedNode

        self._node = SerialisedNode(name, domain_id)
        said, heard = TOPICS
        self._publisher = self._node.publisher(said.name, said.type, Quality(said.depth))
        self._awaited = b""
        self._heard = threading.Event()
        self._node.subscribe(heard.name, heard.type, Quality(heard.depth), self._hear)
        self._clients = {
            s.name.rpartition("/")[2]: self._node.client(s.name, s.type) for s in ACTION_SERVICES
        }

    def _hear(self, message: bytes) -> None:
        if message[:16] == self._awaited:
            self._heard.set()

    def say(self, text_bytes: int) -> float:
        """Return how long a message took to be said again, in seconds."""
        text = os.urandom(4).hex().ljust(text_bytes, "x").encode() + b"\0"
        message = b"\0\1\0\0" + len(text).to_bytes(4, "little") + text
        self._heard.clear()
        self._awaited = message[:16]
        began = time.perf_counter()
        self._publisher.publish(message)
        if not self._heard.wait(CALL_LIMIT_S):
            raise TimeoutError("a message was not said again")
        return time.perf_counter() - began

    def goal(self) -> float:
        """Return how long a goal took, from sending it to its result, in seconds."""
        id = os.urandom(16)
        began = time.perf_counter()
        self._call("send_goal", b"\0\1\0\0" + id + b"\1\0\0\0")
        self._call("get_result", b"\0\1\0\0" + id)
        return time.perf_counter() - began

    def _call(self, part: str, payload: bytes) -> None:
        answered = threading.Event()
        self._clients[part].call(payload, lambda _: answered.set())
        if not answered.wait(CALL_LIMIT_S):
            raise TimeoutError(f"{part} got no answer")

    def wait(self) -> None:
        """Wait until discovery has found everything."""
        limit = time.monotonic() + _READY_S
        while not self._publisher.subscribers() or not all(
            client.available() for client in self._clients.values()
        ):
            if time.monotonic() > limit:
                raise TimeoutError("the topics and the action did not appear")
            time.sleep(0.02)

    def close(self) -> None:
        """Leave ROS."""
        self._node.close()


def graph(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Compare topics and goals directly and through two replicas, in turns, in one run."""
    if importlib.util.find_spec("test_msgs") is None:
        raise RuntimeError("the package test_msgs is not here: install `fogft[ros-test]`")
    rounds = 100 if quick else 600
    kinds: dict[str, tuple[Callable[[Graph], float], str, bytes]] = {
        "topic there and back, 100 B": (lambda g: g.say(100), "flag", bytes(100)),
        "topic there and back, 0.92 MB": (lambda g: g.say(_LARGE), "map", bytes(_LARGE)),
        "goal and its result": (lambda g: g.goal(), "flag", bytes(24)),
    }
    rows = []
    with Rig(folder, 2, graph=True) as rig:
        direct = Graph(rig.domains[0], "bench_direct")
        proxied = Graph(rig.robot_domain, "bench_proxied")
        floor = Floor(rig.floor_folder, rig.floor_port)
        direct.wait()
        proxied.wait()
        for kind, (once, key, payload) in kinds.items():
            count = rounds // 4 if len(payload) > 1000 else rounds
            sides: dict[str, list[float]] = {"direct": [], "proxied": [], "get": []}
            gc.collect()
            for number in range(_WARM_UP + count):
                took = {"direct": once(direct), "proxied": once(proxied)}
                took["get"] = floor.call(key, payload)
                if number >= _WARM_UP:
                    for side, seconds in took.items():
                        sides[side].append(seconds)
            rows.append(_row(kind, sides))
        for one in (direct, proxied):
            one.close()
        floor.close()
    return rows


def _row(kind: str, sides: dict[str, list[float]]) -> dict[str, Any]:
    in_ms = {side: milliseconds(sample) for side, sample in sides.items()}
    found = estimate_of_rounds(
        in_ms,
        lambda s: overhead_ratio(median(s["direct"]), median(s["proxied"]), median(s["get"])),
        random.Random(0),
        resamples=500,
    )
    return {
        "what": kind,
        "replicas": 2,
        "rounds": len(in_ms["direct"]),
        **{f"{side}_ms": median(sample) for side, sample in in_ms.items()},
        "proxied_p99_ms": percentile(in_ms["proxied"], 99),
        "overhead_ratio": {"value": found.value, "low": found.low, "high": found.high},
    }


def bursts(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Send bursts of 100 requests, all at once; count what is lost."""
    count = 5 if quick else 50
    payload = payloads()[FLAG[0]]
    rows = []
    with Rig(folder, 2) as rig:
        for way, domain in (("direct", rig.domains[0]), ("proxied", rig.robot_domain)):
            caller = Caller(domain, f"bench_{way}")
            caller.wait()
            caller.flood(FLAG[0], payload, _BURST, _BURST)
            made = [caller.flood(FLAG[0], payload, _BURST, _BURST) for _ in range(count)]
            caller.close()
            rows.append(
                {
                    "way": way,
                    "replicas": 2,
                    "in_flight": _BURST,
                    "requests": _BURST * count,
                    "lost": _BURST * count - sum(one.answered for one in made),
                    "burst_ms": median([one.seconds * 1000 for one in made]),
                }
            )
    return rows
