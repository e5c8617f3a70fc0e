"""A fast service to measure against: SetBool and SetMap, serialised, with a given delay.

    python tests/bench/service.py SLEEP_S

Answers are made once and sent as bytes, so that the service itself costs next to nothing.
With a delay each request sleeps on a thread of its own, so that requests do not queue.
"""

from __future__ import annotations

import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from fogft.ros import environment, memory_tuning

FLAG = ("/bench_flag", "std_srvs/srv/SetBool")
MAP = ("/bench_map", "nav_msgs/srv/SetMap")


def main() -> None:
    sleep_s = float(sys.argv[1])
    environment.prepare(os.environ)
    from nav_msgs.srv import SetMap
    from rclpy.serialization import serialize_message
    from std_srvs.srv import SetBool

    from fogft.ros.node import SerialisedNode

    memory_tuning.tune()
    node = SerialisedNode("bench_service")
    pool = ThreadPoolExecutor(16)
    answers = {
        FLAG: bytes(serialize_message(SetBool.Response(success=True))),
        MAP: bytes(serialize_message(SetMap.Response(success=True))),
    }
    for (name, type_name), answer in answers.items():
        ends: list[Any] = []

        def answer_now(_: bytes, handle: Any, ends: list[Any] = ends, it: bytes = answer) -> None:
            ends[0].respond(handle, it)

        def answer_later(_: bytes, handle: Any, ends: list[Any] = ends, it: bytes = answer) -> None:
            pool.submit(_respond_after, sleep_s, ends[0], handle, it)

        ends.append(node.serve(name, type_name, answer_later if sleep_s else answer_now))
    threading.Event().wait()  # its server proxy ends it


def _respond_after(sleep_s: float, server: Any, handle: Any, answer: bytes) -> None:
    threading.Event().wait(sleep_s)
    server.respond(handle, answer)


if __name__ == "__main__":
    main()
