"""A measuring client: one ROS node, serialised requests, a clock around each call."""

from __future__ import annotations

import os
import random
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from fogft.model.choices import Speaks
from fogft.proxy import middleware
from tests.bench.nodes.service import FLAG, MAP
from tests.fakes.waiting import wait_for

LARGE_BYTES = 640 * 480 * 3
CALL_LIMIT_S = 10.0
_DISCOVERY_LIMIT_S = 30.0


def payloads(*, poison: bool = False) -> dict[str, bytes]:
    """Return the serialised requests by service: a few bytes, and 0.9 MB.

    Args:
        poison: The first ends the process that serves it, if that sleeps over requests.
    """
    from rclpy.serialization import serialize_message
    from std_srvs.srv import SetBool

    return {
        FLAG[0]: bytes(serialize_message(SetBool.Request(data=not poison))),
        MAP[0]: map_request(LARGE_BYTES),
    }


def map_request(size_bytes: int) -> bytes:
    """Return a serialised request with a map of so many cells."""
    import array

    from nav_msgs.srv import SetMap
    from rclpy.serialization import serialize_message

    large = SetMap.Request()
    large.map.data = array.array("b", bytes(size_bytes))
    return bytes(serialize_message(large))


def is_right_flag(response: bytes) -> bool:
    """Whether a response is what `FLAG`'s service gives: true, and an empty text."""
    return response[4] == 1 and response[8:13] == b"\1\0\0\0\0"


@dataclass
class Flood:
    """Requests kept in flight: how many were answered, and how long it took."""

    answered: int = 0
    seconds: float = 0.0
    answered_at: list[float] = field(default_factory=list)


class Caller:
    """Calls the bench's services in one ROS domain."""

    def __init__(
        self,
        domain_id: int,
        name: str,
        *,
        speaks: Speaks = Speaks.RCLPY,
        environ: Mapping[str, str] = os.environ,
    ) -> None:
        self._node = middleware.join(speaks, name, domain_id, environ=environ).node
        self.wrong = 0
        self._clients: dict[str, Any] = {n: self._node.client(n, t) for n, t in (FLAG, MAP)}

    def wait(self) -> None:
        """Wait until discovery has found the services."""
        there = self._clients.values()
        wait_for(
            lambda: all(client.available() for client in there), _DISCOVERY_LIMIT_S, "the services"
        )

    def ask(self, service: str, payload: bytes, answered: Callable[[], None]) -> None:
        """Send a request, and wait for nothing."""
        self._clients[service].call(payload, lambda _: answered())

    def call(self, service: str, payload: bytes) -> float:
        """Return how long one call took, in seconds.

        Raises:
            TimeoutError: No answer within `CALL_LIMIT_S`.
        """
        answered = threading.Event()
        client = self._clients[service]
        began = time.perf_counter()

        def came(response: bytes) -> None:
            self._judge(service, response)
            answered.set()

        ticket = client.call(payload, came)
        if not answered.wait(CALL_LIMIT_S):
            client.forget(ticket)
            raise TimeoutError(f"{service} got no answer")
        return time.perf_counter() - began

    def flood(self, service: str, payload: bytes, count: int, in_flight: int) -> Flood:
        """Send `count` requests, `in_flight` at a time; wait for all answers."""
        client, result, done = self._clients[service], Flood(), threading.Event()
        sent = min(in_flight, count)
        lock = threading.Lock()

        def answered(_: bytes) -> None:
            nonlocal sent
            with lock:
                result.answered += 1
                again = sent < count
                sent += again
            if again:
                client.call(payload, answered)
            elif result.answered == count:
                done.set()

        began = time.perf_counter()
        for _ in range(sent):
            client.call(payload, answered)
        while not done.wait(CALL_LIMIT_S):
            before = result.answered
            if done.wait(CALL_LIMIT_S) or result.answered == before:
                break
        result.seconds = time.perf_counter() - began
        return result

    def spread(
        self, service: str, payload: bytes, count: int, per_s: float, source: random.Random
    ) -> list[float]:
        """Call at random moments, so many a second on average; return how long each took.

        Calls without an answer are left out; the last ones have `CALL_LIMIT_S` to come. `wrong`
        counts the answers of `FLAG` that its service does not give.
        """
        client, took = self._clients[service], list[float]()

        def answered(sent: float, response: bytes) -> None:
            took.append(time.perf_counter() - sent)
            self._judge(service, response)

        began = time.perf_counter()
        at = began
        for _ in range(count):
            at += source.expovariate(per_s)
            time.sleep(max(0.0, at - time.perf_counter()))
            sent = time.perf_counter()
            client.call(payload, partial(answered, sent))
        end = time.perf_counter() + CALL_LIMIT_S
        while len(took) < count and time.perf_counter() < end:
            time.sleep(0.02)
        return took

    def _judge(self, service: str, response: bytes) -> None:
        self.wrong += service == FLAG[0] and not is_right_flag(response)

    def close(self) -> None:
        """Leave ROS."""
        self._node.close()


def milliseconds(seconds: Sequence[float]) -> list[float]:
    """Return durations in milliseconds."""
    return [s * 1000 for s in seconds]
