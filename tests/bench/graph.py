"""Topics, actions, and bursts of requests: what passing them costs, and that none is lost."""

from __future__ import annotations

import gc
import importlib.util
import os
import random
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from fogft.ros.environment import child_environment
from tests.bench.caller import CALL_LIMIT_S, Caller, milliseconds, payloads
from tests.bench.floor import Floor
from tests.bench.nodes.service import ACTION_SERVICES, FLAG, TOPICS
from tests.bench.rig import ROOT, Rig
from tests.estimates import estimate_of_rounds, median, overhead_ratio, percentile
from tests.fakes.waiting import wait_for

_WARM_UP = 30
_LARGE = 640 * 480 * 3
_BURST = 100
_READY_S = 60.0


class Graph:
    """Says, hears, and sends goals in one ROS domain."""

    def __init__(self, domain_id: int, name: str) -> None:
        from fogft.ros.node import SerialisedNode

        self._node = SerialisedNode(name, domain_id)
        said, heard = TOPICS
        self._publisher = self._node.publisher(said)
        self._awaited = b""
        self._heard = threading.Event()
        self._node.subscribe(heard, self._hear)
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
        wait_for(
            lambda: (
                self._publisher.subscribers()
                and all(client.available() for client in self._clients.values())
            ),
            _READY_S,
            "the topics and the action",
        )

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
    """Send bursts of requests through two replicas; count the answers that are lost.

    Once from a client that keeps every answer, then from plain rclpy clients with default settings,
    of whose requests some may not arrive: their queue has ten places as well.
    """
    times = 1 if quick else 10
    rows = []
    with Rig(folder, 2) as rig:
        for way, domain in (("direct", rig.domains[0]), ("proxied", rig.robot_domain)):
            caller = Caller(domain, f"bench_{way}")
            caller.wait()
            payload = payloads()[FLAG[0]]
            caller.flood(FLAG[0], payload, _BURST, _BURST)
            made = [caller.flood(FLAG[0], payload, _BURST, _BURST) for _ in range(5 * times)]
            caller.close()
            answered = sum(one.answered for one in made)
            seconds = sum(one.seconds for one in made)
            rows.append(_burst(f"keeps all, {way}", _BURST, 5 * times, 0, answered, seconds))
        for count, hold_s, rounds in ((50, 0.0, 10), (200, 0.03, 1), (1000, 0.0, 1)):
            received, answered, seconds = 0, 0, 0.0
            for _ in range(times):
                before = _received(rig)
                words = [f"plain_{count}", str(count), str(hold_s), str(rounds), FLAG[0]]
                began = time.monotonic()
                told = _plain_client(rig.robot_domain, words)
                seconds += time.monotonic() - began
                answered += told
                received += _received(rig) - before
            lost = count * rounds * times - received
            what = f"default, callback {hold_s:g} s"
            rows.append(_burst(what, count, rounds * times, lost, answered, seconds))
    return rows


def _burst(
    client: str, at_once: int, bursts: int, not_arrived: int, answered: int, seconds: float
) -> dict[str, Any]:
    asked = at_once * bursts
    return {
        "client": client,
        "at_once": at_once,
        "requests": asked,
        "did_not_arrive": not_arrived,
        "lost": asked - not_arrived - answered,
        "burst_ms": seconds * 1000 / bursts,
    }


def _plain_client(domain: int, words: Sequence[str]) -> int:
    """Run a plain client; return how many answers it got."""
    command = [sys.executable, str(ROOT / "tests" / "ros" / "nodes" / "plain_client.py"), *words]
    environ = {**child_environment(), "ROS_DOMAIN_ID": str(domain)}
    done = subprocess.run(command, env=environ, input=b"\n", capture_output=True, check=True)
    return int(done.stdout.split()[-1])


def _received(rig: Rig) -> int:
    return int(rig.report(time.time() + 1.0)["services"][FLAG[0]]["received"])
