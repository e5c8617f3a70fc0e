"""A node that waits for a service as programs do: until it is there, is gone, and is there again.

``waiting_robot.py NAME TYPE`` prints ``there`` and ``gone`` as they come about, then calls the
service with a default request and prints its answer.
"""

from __future__ import annotations

import importlib
import sys
import time

import rclpy


def main() -> None:
    name, kind = sys.argv[1:]
    package, _, short = kind.split("/")
    service_type = getattr(importlib.import_module(f"{package}.srv"), short)
    rclpy.init()
    node = rclpy.create_node("waiting_robot")
    client = node.create_client(service_type, name)
    for there in (True, False, True):
        while client.service_is_ready() is not there:
            time.sleep(0.05)
        print("there" if there else "gone", flush=True)
    future = client.call_async(service_type.Request())
    rclpy.spin_until_future_complete(node, future, timeout_sec=20)
    print(future.result(), flush=True)
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
