"""A stateful counter: each call adds FACTOR; the answer tells VERSION and the sum.

Usage: count_service.py VERSION FACTOR
"""

from __future__ import annotations

import sys

import rclpy
from rclpy.node import Node
from std_srvs.srv import SetBool

from fogft.ros.stateful import AttributeState


class Count(Node):
    def __init__(self) -> None:
        super().__init__("count")
        self.total = 0
        self.create_service(SetBool, "/count", self.count)
        self.state = AttributeState(self, "/count", self, "total")

    def count(self, _, response):
        self.total += int(sys.argv[2])
        response.success, response.message = True, f"{sys.argv[1]} {self.total}"
        return response


rclpy.init()
rclpy.spin(Count())
