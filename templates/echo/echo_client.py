"""An ordinary ROS 2 client of `/echo`: asks once or many times and prints what it hears."""

from __future__ import annotations

import argparse
import contextlib
import sys
import threading
from collections.abc import Iterator

import rclpy
from rclpy.client import Client
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.utilities import remove_ros_args
from std_srvs.srv import SetBool


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
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=3, help="how many requests")
    parser.add_argument("--timeout-s", type=float, default=10.0, help="for each answer")
    options = parser.parse_args(remove_ros_args(sys.argv)[1:])
    rclpy.init()
    try:
        node = rclpy.create_node("echo_client")
        client = node.create_client(SetBool, "/echo")
        if not client.wait_for_service(timeout_sec=options.timeout_s):
            print("no service /echo", file=sys.stderr)
            return 1
        with spinning(node):
            for number in range(options.count):
                asked = number % 2 == 0
                answer = call(client, SetBool.Request(data=asked), options.timeout_s)
                if answer is None or answer.message != f"heard {asked}":
                    print(f"request {number}: no answer, or a wrong one", file=sys.stderr)
                    return 1
                print(answer.message, flush=True)
            return 0
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(main())
