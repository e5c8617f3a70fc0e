"""An ordinary ROS 2 service that finds an AprilTag in a camera's image. Runs anywhere, alone too.

Offers `/locate_tag` (pick_interfaces/srv/LocateTag): an image of 640 x 480 takes some 5 ms of a
core. Keeps nothing from request to request, so that any copy of it answers alike.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
import rclpy
from locator import Locator
from pick_interfaces.srv import LocateTag
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile
from rclpy.utilities import remove_ros_args
from rotation import quaternion

# The default keeps 10 requests; what comes while this node is busy must not push them out.
KEEP_ALL = QoSProfile(history=QoSHistoryPolicy.KEEP_ALL)


class TagService(Node):
    """The ROS side: an image in, a pose out."""

    def __init__(self, locator: Locator, service: str) -> None:
        super().__init__("tag_locator")
        self._locator = locator
        self.create_service(LocateTag, service, self._answer, qos_profile=KEEP_ALL)
        self.get_logger().info("ready to locate")

    def _answer(
        self, request: LocateTag.Request, response: LocateTag.Response
    ) -> LocateTag.Response:
        image = request.image
        data = np.frombuffer(bytes(image.data), np.uint8)
        if image.encoding != "mono8" or data.size != image.width * image.height or not data.size:
            self.get_logger().warning("not a mono8 image; the answer is that no tag was found")
            return response
        k = np.array(request.k).reshape(3, 3)
        if not (request.size_m > 0 and np.isfinite(k).all() and k[0, 0] > 0 and k[1, 1] > 0):
            self.get_logger().warning("no camera matrix or size; no pose can be told")
            return response
        mono = data.reshape(image.height, image.width)
        found = self._locator.locate(mono, k, request.id, request.size_m)
        if found is None:
            return response
        place, turned = found
        response.found = True
        at, facing = response.pose.position, response.pose.orientation
        at.x, at.y, at.z = map(float, place)
        facing.x, facing.y, facing.z, facing.w = quaternion(turned)
        return response


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--service", default="/locate_tag", help="name of the service")
    options = parser.parse_args(remove_ros_args(sys.argv)[1:])
    rclpy.init()
    try:
        rclpy.spin(TagService(Locator(), options.service))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
