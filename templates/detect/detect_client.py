"""An ordinary ROS 2 client of `/detect`: draws pictures, asks what is in them, checks the answer.

One request at a time. Prints one JSON object; exits with 1 if a request failed or an answer was
wrong: the thing that was drawn must be the surest one found, where it was drawn.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import sys
import threading
import time
from collections.abc import Iterator

import rclpy
from detect_interfaces.srv import Detect
from pictures import Picture, picture
from rclpy.client import Client
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.utilities import remove_ros_args
from ssd import overlap

LEAST_OVERLAP = 0.5


def request(drawn: Picture) -> Detect.Request:
    """Return the question what is in a picture."""
    asked = Detect.Request(threshold=0.4)
    asked.image.format = "jpeg"
    asked.image.data = drawn.jpeg()
    return asked


def fault(drawn: Picture, answer: Detect.Response) -> str:
    """Say what is wrong with an answer; nothing if it is right."""
    if not answer.labels:
        return f"saw nothing where a {drawn.label} is"
    if answer.labels[0] != drawn.label:
        return f"saw a {answer.labels[0]} where a {drawn.label} is"
    shared = overlap(drawn.box, tuple(answer.boxes[:4]))
    if not shared >= LEAST_OVERLAP:
        return f"saw the {drawn.label} elsewhere: the boxes share {shared:.0%}"
    return ""


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=20, help="how many requests")
    parser.add_argument("--timeout-s", type=float, default=10.0, help="then one has failed")
    parser.add_argument("--wait-s", type=float, default=30.0, help="for the service to appear")
    parser.add_argument("--service", default="/detect", help="name of the service")
    parser.add_argument("--seed", type=int, default=1, help="seed of the pictures")
    return parser.parse_args(remove_ros_args(sys.argv)[1:])


@contextlib.contextmanager
def spinning(node: Node) -> Iterator[None]:
    """Take what arrives in a thread of its own while the block runs."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    try:
        yield
    finally:
        executor.shutdown()
        thread.join()


def call(client: Client, request: object, timeout_s: float) -> object | None:
    """Return the answer to a request; None if none came in time."""
    try:
        return client.call(request, timeout_sec=timeout_s)
    except TimeoutError:  # since Kilted; Jazzy returns None
        return None


def run(options: argparse.Namespace) -> int:
    node = rclpy.create_node("detect_client")
    client = node.create_client(Detect, options.service)
    if not client.wait_for_service(timeout_sec=options.wait_s):
        print(f"no service {options.service} within {options.wait_s} s", file=sys.stderr)
        return 1
    with spinning(node):
        chance = random.Random(options.seed)
        latencies_s, faults, failed = [], [], 0
        for _ in range(options.count):
            drawn = picture(chance)
            asked = request(drawn)
            began = time.monotonic()
            answer = call(client, asked, options.timeout_s)
            if answer is None:
                failed += 1
                continue
            latencies_s.append(time.monotonic() - began)
            wrong = fault(drawn, answer)
            if wrong:
                faults.append(wrong)
        ordered = sorted(latencies_s)
        summary = {
            "requests": options.count,
            "failed": failed,
            "wrong": len(faults),
            "p50_s": round(ordered[len(ordered) // 2], 4) if ordered else None,
            "max_s": round(ordered[-1], 4) if ordered else None,
            "faults": faults[:5],
        }
        print(json.dumps(summary, indent=2), flush=True)
        return 1 if failed or faults else 0


def main() -> int:
    options = arguments()
    rclpy.init()
    try:
        return run(options)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 1
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(main())
