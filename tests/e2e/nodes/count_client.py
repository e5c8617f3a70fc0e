"""Ask /count again and again, one request after the other, until SIGINT; print what was answered.

Nothing here knows of fogft. A request without an answer after 12 s is a null in the list.
"""

from __future__ import annotations

import json
import signal
import sys
import time

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool

rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
node = Node("count_client")
client = node.create_client(SetBool, "/count")
asking = True


def stop(*_: object) -> None:
    global asking
    asking = False


signal.signal(signal.SIGINT, stop)
if not client.wait_for_service(timeout_sec=60.0):
    sys.exit("the service never appeared")
print("asking", file=sys.stderr, flush=True)
answers: list[str | None] = []
while asking:
    future = client.call_async(SetBool.Request(data=True))
    rclpy.spin_until_future_complete(node, future, timeout_sec=12.0)
    answers.append(future.result().message if future.done() else None)
    time.sleep(0.2)
print(json.dumps(answers), flush=True)
