"""An ordinary ROS 2 service that finds an AprilTag in a camera's image. Runs anywhere, alone too.

Offers `/locate_tag` (pick_interfaces/srv/LocateTag): an image of 640 x 480 takes some 5 ms of a
core. Keeps nothing from request to request, so that any copy of it answers alike.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
import pupil_apriltags
import rclpy
from pick_interfaces.srv import LocateTag
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile
from rclpy.utilities import remove_ros_args
from rotation import quaternion
from tag import FAMILY

# The default keeps 10 requests; what comes while this node is busy must not push them out.
KEEP_ALL = QoSProfile(history=QoSHistoryPolicy.KEEP_ALL)


class Locator:
    """The detector, on one thread."""

    def __init__(self) -> None:
        self._detector = pupil_apriltags.Detector(
            families=FAMILY, nthreads=1, quad_decimate=2.0, refine_edges=True
        )

    def locate(
        self, mono: np.ndarray, k: np.ndarray, id: int, size_m: float
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return a tag's place (metres) and rotation matrix as the camera sees it, or None.

        Args:
            mono: The image: height x width bytes.
            k: The camera's matrix, 3 x 3.
            id: Which tag; of several copies of it, the one that is read best.
            size_m: Edge of its black square.
        """
        lens = (k[0, 0], k[1, 1], k[0, 2], k[1, 2])
        seen = self._detector.detect(
            np.ascontiguousarray(mono), estimate_tag_pose=True, camera_params=lens, tag_size=size_m
        )
        right = [each for each in seen if each.tag_id == id]
        if not right:
            return None
        best = max(right, key=lambda each: each.decision_margin)
        return best.pose_t.ravel(), best.pose_R


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
