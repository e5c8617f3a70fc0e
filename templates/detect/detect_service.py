"""An ordinary ROS 2 service that finds objects in images. Runs anywhere, alone too.

Offers `/detect` (detect_interfaces/srv/Detect). Keeps nothing from request to request, so that
any copy of it answers alike.
"""

from __future__ import annotations

import argparse
import io
import sys
from pathlib import Path

import numpy as np
import rclpy
from detect_interfaces.srv import Detect
from PIL import Image
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile
from rclpy.utilities import remove_ros_args
from ssd import LABELS, MODEL, NAME, Detector

# The default keeps 10 requests; what comes while an image takes long must not push them out.
KEEP_ALL = QoSProfile(history=QoSHistoryPolicy.KEEP_ALL)


class DetectService(Node):
    """The ROS side: an encoded image in, boxes out."""

    def __init__(self, detector: Detector, service: str) -> None:
        super().__init__("detector")
        self._detector = detector
        self.create_service(Detect, service, self._answer, qos_profile=KEEP_ALL)
        self.get_logger().info("ready to detect")

    def _answer(self, request: Detect.Request, response: Detect.Response) -> Detect.Response:
        response.model = NAME
        try:
            with Image.open(io.BytesIO(bytes(request.image.data))) as image:
                rgb = np.asarray(image.convert("RGB"))
        except (OSError, SyntaxError, ValueError) as error:
            self.get_logger().warning(f"not an image; the answer is empty: {error}")
            return response
        found = self._detector.detect(rgb, request.threshold or 0.5)
        response.labels = [each.label for each in found]
        response.scores = [each.score for each in found]
        response.boxes = [value for each in found for value in each.box]
        return response


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--service", default="/detect", help="name of the service")
    parser.add_argument(
        "--weights", type=Path, default=Path(__file__).parent / "weights", help="their folder"
    )
    options = parser.parse_args(remove_ros_args(sys.argv)[1:])
    if not all((options.weights / name).is_file() for name in (MODEL, LABELS)):
        print(f"no weights in {options.weights}: run fetch_weights.py", file=sys.stderr)
        return 1
    rclpy.init()
    try:
        rclpy.spin(DetectService(Detector(options.weights), options.service))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
