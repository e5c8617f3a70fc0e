"""An ordinary node with an action and topics: ``acting_node.py FILE STEP_S``.

Writes what it hears and does to FILE, a line each. `/words` is said again on `/echo`; `/map` is
only heard. `/count` (Fibonacci) takes a step each STEP_S.
"""

from __future__ import annotations

import sys
import time

import rclpy
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from test_msgs.action import Fibonacci

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def main() -> None:
    note = open(sys.argv[1], "a", buffering=1)  # noqa: SIM115
    step_s = float(sys.argv[2])
    rclpy.init()
    node = rclpy.create_node("acting")
    echo = node.create_publisher(String, "/echo", 100)

    def words(message: String) -> None:
        print(f"heard {message.data}", file=note)
        echo.publish(message)

    def execute(goal):
        id = bytes(goal.goal_id.uuid).hex()
        print(f"begun {id}", file=note)
        sequence = [0, 1]
        for _ in range(goal.request.order):
            time.sleep(step_s)
            if goal.is_cancel_requested:
                goal.canceled()
                print(f"cancelled {id}", file=note)
                return Fibonacci.Result(sequence=sequence)
            sequence.append(sequence[-1] + sequence[-2])
            goal.publish_feedback(Fibonacci.Feedback(sequence=sequence))
        goal.succeed()
        print(f"done {id}", file=note)
        return Fibonacci.Result(sequence=sequence)

    node.create_subscription(String, "/words", words, 100)
    node.create_subscription(String, "/map", lambda m: print(f"map {m.data}", file=note), LATCHED)
    ActionServer(
        node, Fibonacci, "/count", execute,
        callback_group=ReentrantCallbackGroup(), cancel_callback=lambda _: CancelResponse.ACCEPT,
    )  # fmt: skip
    executor = MultiThreadedExecutor(4)
    executor.add_node(node)
    executor.spin()


if __name__ == "__main__":
    main()
