"""An ordinary ROS 2 client of `/count_words`: asks once and prints what it hears."""

from __future__ import annotations

import sys

import rclpy
from word_interfaces.srv import CountWords

LIMIT_S = 20.0


def main() -> int:
    text = " ".join(sys.argv[1:]) or "every request is answered"
    rclpy.init()
    try:
        node = rclpy.create_node("count_client")
        client = node.create_client(CountWords, "/count_words")
        if not client.wait_for_service(timeout_sec=LIMIT_S):
            print("no service /count_words", file=sys.stderr)
            return 1
        future = client.call_async(CountWords.Request(text=text))
        rclpy.spin_until_future_complete(node, future, timeout_sec=LIMIT_S)
        if not future.done():
            print("no answer", file=sys.stderr)
            return 1
        print(f"{future.result().words} words, {future.result().letters} letters")
        return 0
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(main())
