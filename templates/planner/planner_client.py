"""An ordinary ROS 2 client of `/plan`: asks at a steady pace and checks every answer.

It asks on time whether or not the last answer has come, up to a few open requests: on a slow
machine it asks less often rather than piling up more than can be planned. An answer is wrong
unless its path leads from the request's own start to its own goal and cuts no obstacle.
Prints one JSON object; exits with 1 if a request failed or an answer was wrong.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import sys
import time
from itertools import pairwise

import rclpy
from nav_msgs.srv import GetPlan
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile
from rclpy.task import Future
from rclpy.utilities import remove_ros_args
from scene import Point, Scene

# The default keeps 10 responses: were an eleventh to come while this node is busy, it
# would push out the first.
KEEP_ALL = QoSProfile(history=QoSHistoryPolicy.KEEP_ALL)


class PlannerClient(Node):
    """Sends `count` requests, one a period, and keeps score."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__("planner_client")
        self._options = options
        self._scene = Scene(options.scene)
        self._random = random.Random(options.seed)
        self._client = self.create_client(GetPlan, options.service, qos_profile=KEEP_ALL)
        self._open: dict[Future, float] = {}
        self.sent = 0
        self.failed = 0
        self.wrong: list[str] = []
        self.latencies_s: list[float] = []
        self.answered_at: list[float] = []

    def wait(self) -> bool:
        return self._client.wait_for_service(timeout_sec=self._options.wait_s)

    def run(self) -> None:
        """Return when every request is answered or given up."""
        self.create_timer(self._options.period_s, self._send)
        while self.sent < self._options.count or self._open:
            rclpy.spin_once(self, timeout_sec=0.1)
            self._give_up()

    def _send(self) -> None:
        if self.sent == self._options.count or len(self._open) >= self._options.in_flight:
            return
        self.sent += 1
        rooms = (0, 2) if self._random.random() < 0.5 else (2, 0)
        start, goal = (self._scene.free_point(self._random, room) for room in rooms)
        request = GetPlan.Request()
        request.start.header.frame_id = request.goal.header.frame_id = "map"
        request.start.pose.position.x, request.start.pose.position.y = start
        request.goal.pose.position.x, request.goal.pose.position.y = goal
        future = self._client.call_async(request)
        self._open[future] = time.monotonic()
        future.add_done_callback(lambda done: self._answered(done, start, goal))

    def _answered(self, future: Future, start: Point, goal: Point) -> None:
        asked = self._open.pop(future, None)
        if asked is None:
            return  # given up before; counted as failed
        poses = future.result().plan.poses
        path = [(pose.pose.position.x, pose.pose.position.y) for pose in poses]
        fault = self._scene.fault(path, start, goal)
        if fault:
            self.wrong.append(fault)
            return
        now = time.monotonic()
        self.latencies_s.append(now - asked)
        self.answered_at.append(now)

    def _give_up(self) -> None:
        limit = time.monotonic() - self._options.timeout_s
        for future, asked in list(self._open.items()):
            if asked < limit:
                del self._open[future]
                self._client.remove_pending_request(future)
                self.failed += 1

    def summary(self) -> dict[str, object]:
        gaps = (b - a for a, b in pairwise(self.answered_at))
        return {
            "requests": self.sent,
            "answered": len(self.latencies_s),
            "failed": self.failed,
            "wrong": len(self.wrong),
            "p50_s": percentile(self.latencies_s, 50),
            "p99_s": percentile(self.latencies_s, 99),
            "max_s": percentile(self.latencies_s, 100),
            "longest_gap_s": round(max(gaps, default=0.0), 4),
            "faults": self.wrong[:5],
        }


def percentile(values: list[float], percent: int) -> float | None:
    """The smallest value that is not below this share of all."""
    if not values:
        return None
    rank = max(1, math.ceil(len(values) * percent / 100))
    return round(sorted(values)[rank - 1], 4)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=50, help="how many requests")
    parser.add_argument("--period-s", type=float, default=0.3, help="from request to request")
    parser.add_argument("--in-flight", type=int, default=3, help="open requests, at most")
    parser.add_argument("--timeout-s", type=float, default=35.0, help="then one has failed")
    parser.add_argument("--wait-s", type=float, default=30.0, help="for the service to appear")
    parser.add_argument("--service", default="/plan", help="name of the service")
    parser.add_argument("--scene", type=int, default=7, help="seed of the scene")
    parser.add_argument("--seed", type=int, default=1, help="seed of the requests")
    return parser.parse_args(remove_ros_args(sys.argv)[1:])


def main() -> int:
    options = arguments()
    rclpy.init()
    try:
        client = PlannerClient(options)
        if not client.wait():
            print(f"no service {options.service} within {options.wait_s} s", file=sys.stderr)
            return 1
        client.run()
        summary = client.summary()
        print(json.dumps(summary, indent=2), flush=True)
        return 1 if summary["failed"] or summary["wrong"] else 0
    except (KeyboardInterrupt, ExternalShutdownException):
        return 1
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(main())
