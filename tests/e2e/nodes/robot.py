"""What `ros2 service list`, `type` and `call` ask of ROS, by the same calls of rclpy.

``robot.py NAME TYPE SECONDS [OTHER ...]``: waits for NAME, calls it with a default request, waits
for the OTHER services, since each is discovered by itself, and prints JSON:
``{services: {name: [types]}, answer}``; the answer is null where none was found in time.
"""

from __future__ import annotations

import importlib
import json
import sys
import time

import rclpy


def main() -> None:
    name, kind, seconds, *others = sys.argv[1:]
    end = time.monotonic() + float(seconds)
    package, _, short = kind.split("/")
    service_type = getattr(importlib.import_module(f"{package}.srv"), short)
    rclpy.init()
    node = rclpy.create_node("robot")
    client = node.create_client(service_type, name)
    answer = None
    if client.wait_for_service(timeout_sec=float(seconds)):
        future = client.call_async(service_type.Request())
        rclpy.spin_until_future_complete(node, future, timeout_sec=20)
        answer = str(future.result()) if future.done() else "no response"
    node.destroy_client(client)
    while True:
        found = dict(node.get_service_names_and_types())
        if found.keys() >= set(others) or time.monotonic() >= end:
            break
        time.sleep(0.05)
    print(json.dumps({"services": found, "answer": answer}))
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
