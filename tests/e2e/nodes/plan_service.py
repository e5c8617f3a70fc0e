"""An ordinary rclpy service: a straight line from start to goal, after a little work.

Nothing here knows of fogft. Each answer repeats its request's start, goal and number, so
that a client can tell a wrong answer from a right one.
"""

from __future__ import annotations

import os
import sys
import time

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.srv import GetPlan
from rclpy.node import Node


class PlanService(Node):
    def __init__(self, work_s: float) -> None:
        super().__init__("plan_service")
        self._work_s = work_s
        self.create_service(GetPlan, "/plan", self.plan)

    def plan(self, request: GetPlan.Request, response: GetPlan.Response) -> GetPlan.Response:
        time.sleep(self._work_s)
        middle = PoseStamped()
        middle.pose.position.x = (request.start.pose.position.x + request.goal.pose.position.x) / 2
        response.plan.poses = [request.start, middle, request.goal]
        response.plan.header.frame_id = f"{request.tolerance:.0f}"
        if request.tolerance < 0:  # a poisonous request: the service dies of it
            os._exit(3)
        return response


def main() -> None:
    rclpy.init()
    node = PlanService(float(sys.argv[1]) if len(sys.argv) > 1 else 0.005)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
