"""An ordinary ROS 2 client of `/segment`: asks for masks, one at a time or at a steady pace.

An answer is wrong unless its mask has the image's size and equals the first answer to the same
question. Prints one JSON object; exits with 1 if a request failed or an answer was wrong.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import threading
import time
from collections.abc import Iterator

import numpy as np
import rclpy
from PIL import Image
from rclpy.client import Client
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.utilities import remove_ros_args
from segment_interfaces.srv import Segment

WIDTH, HEIGHT = 320, 240
QUESTIONS = 4


def question(number: int) -> Segment.Request:
    """Return one of a few questions: an image of coloured discs, and the middle of one of them."""
    chance = np.random.default_rng(number)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    image = np.full((HEIGHT, WIDTH, 3), 200, np.uint8)
    asked = Segment.Request()
    for _ in range(5):
        x, y, r = chance.uniform((40, 40, 15), (WIDTH - 40, HEIGHT - 40, 40))
        image[(columns - x) ** 2 + (rows - y) ** 2 < r * r] = chance.integers(0, 255, 3)
        asked.x, asked.y = float(x), float(y)
    out = io.BytesIO()
    Image.fromarray(image).save(out, "PNG")
    asked.image.format = "png"
    asked.image.data = out.getvalue()
    return asked


def fault(answer: Segment.Response, before: Segment.Response | None) -> str:
    """Say what is wrong with an answer; nothing if it is right."""
    if (answer.width, answer.height) != (WIDTH, HEIGHT):
        return f"a mask of {answer.width} x {answer.height} for an image of {WIDTH} x {HEIGHT}"
    if len(answer.mask) != WIDTH * HEIGHT // 8 or not np.isfinite(answer.score):
        return "the mask has not as many bits as the image has pixels, or no score"
    if before is None:
        return ""
    # Another processor rounds otherwise: a few pixels on the rim may differ.
    ours, theirs = (np.frombuffer(bytes(each.mask), np.uint8) for each in (answer, before))
    if np.unpackbits(ours ^ theirs).mean() > 0.01:
        return "another mask than the first time"
    return ""


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=10, help="how many requests")
    parser.add_argument("--period-s", type=float, default=0.0, help="from request to request")
    parser.add_argument("--timeout-s", type=float, default=60.0, help="then one has failed")
    parser.add_argument("--wait-s", type=float, default=60.0, help="for the service to appear")
    parser.add_argument("--service", default="/segment", help="name of the service")
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
    node = rclpy.create_node("segment_client")
    client = node.create_client(Segment, options.service)
    if not client.wait_for_service(timeout_sec=options.wait_s):
        print(f"no service {options.service} within {options.wait_s} s", file=sys.stderr)
        return 1
    with spinning(node):
        questions = [question(number) for number in range(QUESTIONS)]
        first: dict[int, Segment.Response] = {}
        latencies_s, faults, failed = [], [], 0
        for number in range(options.count):
            which = number % QUESTIONS
            began = time.monotonic()
            answer = call(client, questions[which], options.timeout_s)
            took_s = time.monotonic() - began
            if answer is None:
                failed += 1
            else:
                latencies_s.append(took_s)
                wrong = fault(answer, first.get(which))
                first.setdefault(which, answer)
                faults += [wrong] if wrong else []
            time.sleep(max(0.0, options.period_s - took_s))
        ordered = sorted(latencies_s)
        summary = {
            "requests": options.count,
            "failed": failed,
            "wrong": len(faults),
            "p50_s": round(ordered[len(ordered) // 2], 4) if ordered else None,
            "max_s": round(ordered[-1], 4) if ordered else None,
            "model": first[0].model if 0 in first else None,
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
