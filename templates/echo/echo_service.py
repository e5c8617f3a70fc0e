"""An ordinary ROS 2 service: `/echo` (std_srvs/srv/SetBool) answers what it was told."""

from __future__ import annotations

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_srvs.srv import SetBool


class Echo(Node):
    def __init__(self) -> None:
        super().__init__("echo")
        self.create_service(SetBool, "/echo", self._answer)

    def _answer(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success = True
        response.message = f"heard {request.data}"
        return response


def main() -> None:
    rclpy.init()
    try:
        rclpy.spin(Echo())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
