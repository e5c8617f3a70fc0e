"""An ordinary ROS 2 client of `/next_place`: asks for places and prints each, as JSON lines.

A request that is not answered in time is asked again under the same id: it may have been carried
out, and is then answered with the place that it was given.
"""

from __future__ import annotations

import argparse
import json
import sys
import uuid

import rclpy
from nav_msgs.srv import GetPlan
from rclpy.client import Client
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

ATTEMPTS = 12
ATTEMPT_S = 6.0  # longer than the service's `timeout_s` in the pool file


def next_place(node: Node, client: Client) -> tuple[float, float] | None:
    """Return where to inspect next; None where nobody has answered, many times."""
    request = GetPlan.Request()
    request.goal.header.frame_id = str(uuid.uuid4())
    for _ in range(ATTEMPTS):
        future = client.call_async(request)
        rclpy.spin_until_future_complete(node, future, timeout_sec=ATTEMPT_S)
        if future.done():
            position = future.result().plan.poses[0].pose.position
            return position.x, position.y
        client.remove_pending_request(future)
    return None


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10, help="how many places")
    options = parser.parse_args(remove_ros_args(sys.argv)[1:])
    rclpy.init()
    try:
        node = rclpy.create_node("inspection_client")
        client = node.create_client(GetPlan, "/next_place")
        if not client.wait_for_service(timeout_sec=60.0):
            print("no service /next_place", file=sys.stderr)
            return 1
        for _ in range(options.count):
            place = next_place(node, client)
            if place is None:
                print("no answer", file=sys.stderr)
                return 1
            print(json.dumps(place), flush=True)
        return 0
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(main())
