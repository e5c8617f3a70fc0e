"""An ordinary ROS 2 service that plans a robot's way with OMPL. Runs anywhere, alone too.

Offers `/plan` (nav_msgs/srv/GetPlan): from `start` to `goal` through the scene of
`scene.py`, for a round robot. The planner samples at random, so that the same request
takes a few milliseconds at one time and some hundred at another.
"""

from __future__ import annotations

import argparse
import math
import sys
from itertools import pairwise

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.srv import GetPlan
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile
from rclpy.utilities import remove_ros_args
from scene import MARGIN, ROBOT_RADIUS, SIZE, Point, Scene

# The default keeps 10 requests: were an eleventh to come while a plan takes long, the first
# of those that wait would be lost.
KEEP_ALL = QoSProfile(history=QoSHistoryPolicy.KEEP_ALL)
STEP = 1.0  # metres that a tree grows at a time
RESOLUTION = 0.002  # distance between two tests of a motion, in parts of the floor's diagonal


class Planner:
    """RRT-Connect in one scene. Holds no state between two plans."""

    def __init__(self, scene: Scene, limit_s: float) -> None:
        self._limit_s = limit_s
        distance = ROBOT_RADIUS + MARGIN
        self._solids = [(b.x0, b.y0, b.x1, b.y1) for b in scene.solids(distance)]
        bounds = ob.RealVectorBounds(2)
        for axis in range(2):
            bounds.setLow(axis, distance)
            bounds.setHigh(axis, SIZE - distance)
        self._space = ob.RealVectorStateSpace(2)
        self._space.setBounds(bounds)

    def free(self, state: ob.State) -> bool:
        x, y = state[0], state[1]
        return not any(x0 < x < x1 and y0 < y < y1 for x0, y0, x1, y1 in self._solids)

    def plan(self, start: Point, goal: Point) -> list[Point]:
        """Points from start to goal; none if no way was found in time."""
        setup = og.SimpleSetup(self._space)
        setup.setStateValidityChecker(self.free)
        information = setup.getSpaceInformation()
        information.setStateValidityCheckingResolution(RESOLUTION)
        setup.setStartAndGoalStates(self._state(start), self._state(goal))
        planner = og.RRTConnect(information)
        planner.setRange(STEP)
        setup.setPlanner(planner)
        setup.solve(self._limit_s)
        if not setup.haveExactSolutionPath():
            return []
        return [(state[0], state[1]) for state in setup.getSolutionPath().getStates()]

    def _state(self, point: Point) -> ob.State:
        state = self._space.allocState()
        state[0], state[1] = point
        return state


class PlannerService(Node):
    """The ROS side: poses in, poses out."""

    def __init__(self, planner: Planner) -> None:
        super().__init__("planner")
        self._planner = planner
        self.create_service(GetPlan, "/plan", self._answer, qos_profile=KEEP_ALL)
        self.get_logger().info("ready to plan")

    def _answer(self, request: GetPlan.Request, response: GetPlan.Response) -> GetPlan.Response:
        points = self._planner.plan(_point(request.start), _point(request.goal))
        response.plan.header = request.start.header
        if not points:
            self.get_logger().warning("found no way; the answer is an empty path")
            return response
        between = [_pose(request, a, b) for a, b in pairwise(points[1:])]
        response.plan.poses = [request.start, *between, request.goal]
        return response


def _point(pose: PoseStamped) -> Point:
    return pose.pose.position.x, pose.pose.position.y


def _pose(request: GetPlan.Request, here: Point, there: Point) -> PoseStamped:
    """A pose here that looks there."""
    pose = PoseStamped(header=request.start.header)
    pose.pose.position.x, pose.pose.position.y = here
    yaw = math.atan2(there[1] - here[1], there[0] - here[0])
    pose.pose.orientation.z, pose.pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    return pose


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=int, default=7, help="seed of the scene")
    parser.add_argument("--limit-s", type=float, default=25.0, help="give up planning after this")
    options = parser.parse_args(remove_ros_args(sys.argv)[1:])
    ou.setLogLevel(ou.LogLevel.LOG_ERROR)
    rclpy.init()
    try:
        rclpy.spin(PlannerService(Planner(Scene(options.scene), options.limit_s)))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
