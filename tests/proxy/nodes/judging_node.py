"""``SetBool`` answered by ``yes`` or ``no``, after a moment; or at once, by the opposite.

python judging_node.py honest|lies
"""

from __future__ import annotations

import sys
import time

import rclpy
from std_srvs.srv import SetBool

rclpy.init()
node = rclpy.create_node("judging")


def judge(request, response):
    lies = sys.argv[1] == "lies"
    if not lies:
        time.sleep(0.01)
    response.success = True
    response.message = "yes" if request.data != lies else "no"
    return response


node.create_service(SetBool, "/judge", judge)
rclpy.spin(node)
