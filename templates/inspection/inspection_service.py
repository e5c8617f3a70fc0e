"""An ordinary ROS 2 service: `/next_place` (nav_msgs/srv/GetPlan) tells where to inspect next.

The places are those of a grid, each given out once. `GetPlan` has no field for a request's id, so
`goal.header.frame_id` carries it; a type of your own would have a `request_id`.
"""

from __future__ import annotations

import os

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.srv import GetPlan
from places import Places
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

COLUMNS = 10


class Inspection(Node):
    def __init__(self, places: Places) -> None:
        super().__init__("inspection")
        self._places = places
        self.create_service(GetPlan, "/next_place", self._answer)

    def _answer(self, request: GetPlan.Request, response: GetPlan.Response) -> GetPlan.Response:
        row, column = divmod(self._places.take(request.goal.header.frame_id), COLUMNS)
        pose = PoseStamped()
        pose.header.frame_id = "map"
        pose.pose.position.x, pose.pose.position.y = float(column), float(row)
        response.plan.poses.append(pose)
        return response


def main() -> None:
    rclpy.init()
    try:
        rclpy.spin(Inspection(Places(os.environ["ETCD_URLS"].split(","))))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
