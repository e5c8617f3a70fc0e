"""An ordinary ROS 2 service that moves a rigid body through a scene. Runs anywhere, alone too.

Offers `/plan` (nav_msgs/srv/GetPlan): poses from `start` to `goal`, whose frame names the scene of
`scenes.py`. A search that takes more than `limit_s` ends with no poses. `/plan_stop`
(std_srvs/srv/Trigger) ends the one at work: whoever has an answer already need not wait.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
import threading
import time
from collections.abc import Sequence

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.srv import GetPlan
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile
from rigid_body import Planner, Pose, Way
from scenes import NAMES, load
from std_srvs.srv import Trigger

# The default keeps 10 requests: were an eleventh to come while a search takes long, the first
# of those that wait would be lost.
KEEP_ALL = QoSProfile(history=QoSHistoryPolicy.KEEP_ALL)


class MotionService(Node):
    """The ROS side: poses in, poses out."""

    def __init__(self) -> None:
        super().__init__("motion")
        omplapp = self.declare_parameter("omplapp", "").value
        self._limit_s = self.declare_parameter("limit_s", 100.0).value
        self._record = self.declare_parameter("record", "").value
        self._planners = {name: Planner(load(name, omplapp)) for name in NAMES}
        self._stop = threading.Event()
        plan, stop = MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()
        self.create_service(
            GetPlan, "/plan", self._answer, qos_profile=KEEP_ALL, callback_group=plan
        )
        self.create_service(Trigger, "/plan_stop", self._end, callback_group=stop)
        self.get_logger().info("ready to plan")

    def _answer(self, request: GetPlan.Request, response: GetPlan.Response) -> GetPlan.Response:
        response.plan.header = request.start.header
        planner = self._planners.get(request.start.header.frame_id)
        if planner is None:
            self.get_logger().warning(f"no scene `{request.start.header.frame_id}`")
            return response
        self._stop.clear()
        began = time.perf_counter()
        until = began + self._limit_s
        way = planner.plan(
            pose_of(request.start),
            pose_of(request.goal),
            lambda: self._stop.is_set() or time.perf_counter() > until,
        )
        self._note(way, time.perf_counter() - began)
        response.plan.poses = [_stamped(request, pose) for pose in way.poses]
        return response

    def _end(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._stop.set()
        response.success = True
        return response

    def _note(self, way: Way, seconds: float) -> None:
        """Log what a search took; a line of JSON where `record` names a file."""
        self.get_logger().info(f"searched: checks={way.checks} seconds={seconds:.3f}")
        if self._record:
            line = {
                "pid": os.getpid(),
                "answer": digest(way.poses),
                "checks": way.checks,
                "seconds": seconds,
            }
            with open(self._record, "a") as file:
                file.write(json.dumps(line) + "\n")


def digest(poses: Sequence[Pose]) -> str:
    """Return a fingerprint of a way: no two searches find the same; of no poses, nothing."""
    return hashlib.sha256(b"".join(struct.pack("7d", *p) for p in poses)).hexdigest()[:16] * bool(
        poses
    )


def pose_of(stamped: PoseStamped) -> Pose:
    """Return a ROS pose as numbers."""
    at, turn = stamped.pose.position, stamped.pose.orientation
    return (at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)


def fill(stamped: PoseStamped, pose: Pose) -> PoseStamped:
    """Write numbers into a ROS pose; return it."""
    at, turn = stamped.pose.position, stamped.pose.orientation
    at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w = pose
    return stamped


def _stamped(request: GetPlan.Request, pose: Pose) -> PoseStamped:
    return fill(PoseStamped(header=request.start.header), pose)


def main() -> None:
    rclpy.init()
    try:
        rclpy.spin(MotionService(), executor=MultiThreadedExecutor(2))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
        os._exit(0)  # the planner's bindings would complain about objects that live until the end


if __name__ == "__main__":
    main()
