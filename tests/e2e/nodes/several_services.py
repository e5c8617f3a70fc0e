"""A node with services under relative, private and absolute names, and an action-like one."""

from __future__ import annotations

import rclpy
from nav_msgs.srv import GetPlan
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger


class Several(Node):
    def __init__(self) -> None:
        super().__init__("several")
        self.create_service(SetBool, "flip", self._flip)
        self.create_service(Trigger, "~/reset", self._trigger)
        self.create_service(GetPlan, "/plan", lambda _, response: response)
        self.create_client(Trigger, "/only_called")  # a client is no offer

    def _flip(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success = not request.data
        return response

    def _trigger(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = self.get_fully_qualified_name()
        return response


def main() -> None:
    rclpy.init()
    rclpy.spin(Several())


if __name__ == "__main__":
    main()
