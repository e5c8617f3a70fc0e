"""``SetBool`` at /work that works until a gate is open or it is told to stop; a log of what it did.

python gated_node.py NAME,GATE,LOG

GATE is a file: while it is there, requests are answered at once. LOG gets a line when a request
is done: what it asked, and whether it was ended by /work_cancel.
"""

from __future__ import annotations

import sys
import threading
from pathlib import Path

import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.qos import HistoryPolicy, QoSProfile
from std_srvs.srv import SetBool, Trigger

name, gate, log = sys.argv[1].split(",")
stopped = threading.Event()
rclpy.init()
node = rclpy.create_node(name)
group = ReentrantCallbackGroup()
quality = QoSProfile(history=HistoryPolicy.KEEP_ALL)


def work(request, response):
    stopped.clear()
    while not Path(gate).exists() and not stopped.wait(0.02):
        pass
    response.success = not stopped.is_set()
    response.message = name
    with Path(log).open("a") as file:
        file.write(f"{name} {request.data} {'stopped' if stopped.is_set() else 'done'}\n")
    return response


def cancel(_, response):
    stopped.set()
    response.success = True
    return response


node.create_service(SetBool, "/work", work, callback_group=group, qos_profile=quality)
node.create_service(Trigger, "/work_cancel", cancel, callback_group=group)
executor = MultiThreadedExecutor(num_threads=4)
executor.add_node(node)
executor.spin()
