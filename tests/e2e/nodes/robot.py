"""What `ros2 service list`, `type` and `call` ask of ROS, by the same calls of rclpy.

``robot.py NAME TYPE SECONDS``: waits for NAME, calls it with a default request, prints JSON:
``{services: {name: [types]}, answer}``; the answer is null where none was found in time.
"""

from __future__ import annotations

import importlib
import json
import sys

import rclpy


def main() -> None:
    name, kind, seconds = sys.argv[1], sys.argv[2], float(sys.argv[3])
    package, _, short = kind.split("/")
    service_type = getattr(importlib.import_module(f"{package}.srv"), short)
    rclpy.init()
    node = rclpy.create_node("robot")
    client = node.create_client(service_type, name)
    answer = None
    if client.wait_for_service(timeout_sec=seconds):
        future = client.call_async(service_type.Request())
        rclpy.spin_until_future_complete(node, future, timeout_sec=20)
        answer = str(future.result()) if future.done() else "no response"
    node.destroy_client(client)
    found = dict(node.get_service_names_and_types())
    print(json.dumps({"services": found, "answer": answer}))
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
