"""An ordinary ROS 2 client of `/echo`: asks once or many times and prints what it hears."""

from __future__ import annotations

import argparse
import sys

import rclpy
from rclpy.utilities import remove_ros_args
from std_srvs.srv import SetBool


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
        for number in range(options.count):
            asked = number % 2 == 0
            future = client.call_async(SetBool.Request(data=asked))
            rclpy.spin_until_future_complete(node, future, timeout_sec=options.timeout_s)
            if not future.done() or future.result().message != f"heard {asked}":
                print(f"request {number}: no answer, or a wrong one", file=sys.stderr)
                return 1
            print(future.result().message, flush=True)
        return 0
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(main())
