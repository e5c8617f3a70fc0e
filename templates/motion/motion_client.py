"""An ordinary ROS 2 client of `/plan`: asks for ways through a scene and checks every answer."""

from __future__ import annotations

import argparse
import os
import sys
import time

import rclpy
from motion_service import fill, pose_of
from nav_msgs.srv import GetPlan
from rclpy.node import Node
from rclpy.utilities import remove_ros_args
from rigid_body import Planner, unturned
from scenes import NAMES, load


def request_for(name: str, start: object, goal: object) -> GetPlan.Request:
    """Return a request whose frame names its scene."""
    request = GetPlan.Request()
    for stamped, pose in ((request.start, start), (request.goal, goal)):
        fill(stamped, pose)
        stamped.header.frame_id = name
    return request


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=5, help="how many requests")
    parser.add_argument("--scene", choices=NAMES, default="cubicles", help="which scene")
    parser.add_argument("--timeout-s", type=float, default=110.0, help="then one has failed")
    parser.add_argument("--wait-s", type=float, default=30.0, help="for the service to appear")
    options = parser.parse_args(remove_ros_args(sys.argv)[1:])
    scene = load(options.scene)
    judge, start, goal = Planner(scene), unturned(scene.start), unturned(scene.goal)
    rclpy.init()
    node = Node("motion_client")
    client = node.create_client(GetPlan, "/plan")
    if not client.wait_for_service(timeout_sec=options.wait_s):
        print(f"no service /plan within {options.wait_s} s", file=sys.stderr)
        return 1
    for _ in range(options.count):
        began = time.monotonic()
        future = client.call_async(request_for(options.scene, start, goal))
        rclpy.spin_until_future_complete(node, future, timeout_sec=options.timeout_s)
        if not future.done():
            print(f"no answer within {options.timeout_s} s", file=sys.stderr)
            return 1
        way = [pose_of(stamped) for stamped in future.result().plan.poses]
        fault = judge.fault(way, start, goal)
        print(f"{len(way)} poses in {time.monotonic() - began:.3f} s {fault}", flush=True)
        if fault:
            return 1
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    os._exit(status)  # the planner's bindings would complain about objects that live until the end
