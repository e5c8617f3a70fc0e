"""A fast service to measure against: SetBool and SetMap, serialised, with a given delay.

    python tests/bench/nodes/service.py SLEEP_S [SIGMA STALLED STALL_S WORKERS]

Answers are made once and sent as bytes, so that the service itself costs next to nothing.
With a delay requests sleep on WORKERS threads (16), for SLEEP_S, or for lognormal times of
that median and sigma; a share STALLED of them sleeps STALL_S longer. `/bench_cancel` ends
every sleep under way.
"""

from __future__ import annotations

import os
import random
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from fogft.model.choices import Speaks
from fogft.model.topic import ActionSpec, Origin, TopicSpec
from fogft.poolfile.pool import action_services
from fogft.proxy import middleware

FLAG = ("/bench_flag", "std_srvs/srv/SetBool")
MAP = ("/bench_map", "nav_msgs/srv/SetMap")
STATEFUL = "FOGFT_BENCH_STATEFUL"  # set: both services can be given a state, which is empty
SPEAKS = "FOGFT_BENCH_RMW"  # how the service speaks ROS, as `rmw` in a pool file
GRAPH = "FOGFT_BENCH_GRAPH"  # set: it says again what it hears on a topic, and takes goals
STRING = "std_msgs/msg/String"
FIBONACCI = "test_msgs/action/Fibonacci"
TOPICS = (
    TopicSpec("/bench_in", STRING, Origin.ROBOT, depth=100),
    TopicSpec("/bench_out", STRING, Origin.REPLICAS, depth=100),
)
ACTION_SERVICES = action_services(ActionSpec("/bench_act", FIBONACCI, 10.0, 60.0))
_SMALL_BYTES = 8
CANCEL = ("/bench_cancel", "std_srvs/srv/Trigger")
_DEFAULTS = ("0", "0", "0", "0", "16")


def main() -> None:
    given = sys.argv[1:]
    sleep_s, sigma, stalled, stall_s, workers = map(float, (*given, *_DEFAULTS[len(given) :]))
    speaks = Speaks(os.environ.get(SPEAKS, "rclpy"))
    middleware.prepare(speaks)
    from nav_msgs.srv import SetMap
    from rclpy.serialization import serialize_message
    from std_srvs.srv import SetBool, Trigger

    node = middleware.join(speaks, "bench_service", None).node
    pool = ThreadPoolExecutor(int(workers))
    sleeps = Sleeps(sleep_s, sigma, stalled, stall_s)
    answers = {
        FLAG: bytes(serialize_message(SetBool.Response(success=True))),
        MAP: bytes(serialize_message(SetMap.Response(success=True))),
    }
    for (name, type_name), answer in answers.items():
        ends: list[Any] = []

        def answer_now(_: bytes, handle: Any, ends: list[Any] = ends, it: bytes = answer) -> None:
            ends[0].respond(handle, it)

        def answer_later(
            request: bytes, handle: Any, ends: list[Any] = ends, it: bytes = answer
        ) -> None:
            if request[4] == 0 and len(request) <= _SMALL_BYTES:  # SetBool of false
                os._exit(1)
            pool.submit(_respond_after, sleeps, ends[0], handle, it)

        ends.append(node.serve(name, type_name, answer_later if sleep_s else answer_now))
    if os.environ.get(STATEFUL):
        _offer_states(node, SetMap.Response(success=True))
    if os.environ.get(GRAPH):
        _offer_graph(node)
    stopped = bytes(serialize_message(Trigger.Response(success=True)))

    def stop(_: bytes, handle: Any) -> None:
        sleeps.end()
        cancel.respond(handle, stopped)

    cancel = node.serve(*CANCEL, stop)
    threading.Event().wait()  # its server proxy ends it


def _offer_states(node: Any, restored: Any) -> None:
    from nav_msgs.srv import GetMap
    from rclpy.serialization import serialize_message

    answers = {"get": ("Get", GetMap.Response()), "set": ("Set", restored)}
    for service, _ in (FLAG, MAP):
        for verb, (prefix, response) in answers.items():
            ends: list[Any] = []
            answer = bytes(serialize_message(response))

            def respond(_: bytes, handle: Any, ends: list[Any] = ends, it: bytes = answer) -> None:
                ends[0].respond(handle, it)

            name = f"{service}/{verb}_state"
            ends.append(node.serve(name, f"nav_msgs/srv/{prefix}Map", respond))


def _offer_graph(node: Any) -> None:
    """Say again what is heard; take every goal, which succeeds at once."""
    from rclpy.serialization import serialize_message
    from test_msgs.action import Fibonacci

    heard, said = TOPICS
    again = node.publisher(said)
    node.subscribe(heard, again.publish)
    parts = Fibonacci.Impl
    answers = {
        "send_goal": parts.SendGoalService.Response(accepted=True),
        "cancel_goal": parts.CancelGoalService.Response(),
        "get_result": parts.GetResultService.Response(status=4),
    }
    for service in ACTION_SERVICES:
        ends: list[Any] = []
        answer = bytes(serialize_message(answers[service.name.rpartition("/")[2]]))

        def respond(_: bytes, handle: Any, ends: list[Any] = ends, it: bytes = answer) -> None:
            ends[0].respond(handle, it)

        ends.append(node.serve(service.name, service.type, respond))


class Sleeps:
    """Sleeps that can be ended early, all together."""

    def __init__(self, median_s: float, sigma: float, stalled: float, stall_s: float) -> None:
        self._median_s = median_s
        self._sigma = sigma
        self._stalled = stalled
        self._stall_s = stall_s
        self._source = random.Random()
        self._end = threading.Event()

    def sleep(self) -> None:
        """Sleep for a drawn time."""
        seconds = self._median_s * self._source.lognormvariate(0.0, self._sigma)
        if self._source.random() < self._stalled:
            seconds += self._stall_s
        self._end.wait(seconds)

    def end(self) -> None:
        """End the sleeps that are under way."""
        old, self._end = self._end, threading.Event()
        old.set()


def _respond_after(sleeps: Sleeps, server: Any, handle: Any, answer: bytes) -> None:
    sleeps.sleep()
    server.respond(handle, answer)


if __name__ == "__main__":
    main()
