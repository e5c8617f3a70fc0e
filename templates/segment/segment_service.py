"""An ordinary ROS 2 service that cuts out what is at a point of an image. Runs anywhere.

Offers `/segment` (segment_interfaces/srv/Segment), one image at a time, as a GPU would serve
them. Keeps nothing from request to request, so that any copy of it answers alike.
"""

from __future__ import annotations

import argparse
import io
import sys
from pathlib import Path

import numpy as np
import rclpy
from PIL import Image
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile
from rclpy.utilities import remove_ros_args
from sam import SIZES, Segmenter
from segment_interfaces.srv import Segment

# The default keeps 10 requests; what comes while an image takes long must not push them out.
KEEP_ALL = QoSProfile(history=QoSHistoryPolicy.KEEP_ALL)


class SegmentService(Node):
    """The ROS side: an encoded image and a point in, a mask out."""

    def __init__(self, segmenter: Segmenter, service: str) -> None:
        super().__init__("segmenter")
        self._segmenter = segmenter
        segmenter.segment(np.zeros((64, 64, 3), np.uint8), 32, 32)  # the first one takes longer
        self.create_service(Segment, service, self._answer, qos_profile=KEEP_ALL)
        self.get_logger().info(f"ready to segment: {segmenter.name}")

    def _answer(self, request: Segment.Request, response: Segment.Response) -> Segment.Response:
        response.model = self._segmenter.name
        try:
            with Image.open(io.BytesIO(bytes(request.image.data))) as image:
                rgb = np.asarray(image.convert("RGB"))
        except (OSError, SyntaxError, ValueError) as error:
            self.get_logger().warning(f"not an image; the answer is empty: {error}")
            return response
        mask, score = self._segmenter.segment(rgb, request.x, request.y)
        response.height, response.width = mask.shape
        response.mask = np.packbits(mask).tobytes()
        response.score = score
        return response


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--service", default="/segment", help="name of the service")
    parser.add_argument("--size", choices=SIZES, default="tiny", help="of the network")
    parser.add_argument("--weights", type=Path, help="folder of a checkpoint")
    parser.add_argument("--threads", type=int, default=1, help="cores that an image may use")
    options = parser.parse_args(remove_ros_args(sys.argv)[1:])
    rclpy.init()
    try:
        segmenter = Segmenter(options.size, options.weights, options.threads)
        rclpy.spin(SegmentService(segmenter, options.service))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
