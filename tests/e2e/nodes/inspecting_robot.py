"""The example `inspection`'s client at ten requests a second at most, until SIGINT.

``inspecting_robot.py FOLDER``, where the example lies, prints as the example's client does.
"""

from __future__ import annotations

import json
import signal
import sys
import threading

import rclpy
from nav_msgs.srv import GetPlan
from rclpy.signals import SignalHandlerOptions


def main() -> None:
    sys.path.insert(0, sys.argv[1])
    from inspection_client import next_place

    enough = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: enough.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("inspecting_robot")
    client = node.create_client(GetPlan, "/next_place")
    if not client.wait_for_service(timeout_sec=60.0):
        sys.exit("no service /next_place")
    while not enough.wait(0.1):
        place = next_place(node, client)
        if place is None:
            sys.exit("no answer")
        print(json.dumps(place), flush=True)
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
