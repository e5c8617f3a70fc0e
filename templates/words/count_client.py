"""An ordinary ROS 2 client of `/count_words`: asks once and prints what it hears."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Iterator

import rclpy
from rclpy.client import Client
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from word_interfaces.srv import CountWords

LIMIT_S = 20.0


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


def main() -> int:
    text = " ".join(sys.argv[1:]) or "every request is answered"
    rclpy.init()
    try:
        node = rclpy.create_node("count_client")
        client = node.create_client(CountWords, "/count_words")
        if not client.wait_for_service(timeout_sec=LIMIT_S):
            print("no service /count_words", file=sys.stderr)
            return 1
        with spinning(node):
            answer = call(client, CountWords.Request(text=text), LIMIT_S)
            if answer is None:
                print("no answer", file=sys.stderr)
                return 1
            print(f"{answer.words} words, {answer.letters} letters")
            return 0
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(main())
