"""An ordinary ROS 2 client of `/plan`: asks for ways through a scene and checks every answer."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import threading
import time
from collections.abc import Iterator

import rclpy
from motion_service import fill, pose_of
from nav_msgs.srv import GetPlan
from rclpy.client import Client
from rclpy.executors import SingleThreadedExecutor
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
    with spinning(node):
        for _ in range(options.count):
            began = time.monotonic()
            answer = call(client, request_for(options.scene, start, goal), options.timeout_s)
            if answer is None:
                print(f"no answer within {options.timeout_s} s", file=sys.stderr)
                return 1
            way = [pose_of(stamped) for stamped in answer.plan.poses]
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
