"""An ordinary rclpy client: asks at a steady rate, checks each answer against its request.

Usage: plan_client.py SECONDS RATE_HZ [LIMIT_S [FILE]]. Ends after SECONDS or at SIGINT, once every
request is answered or given up, and prints one JSON object; a request without an answer after
LIMIT_S has failed. FILE gets a line for each request at its end: when it was asked and answered,
and whether rightly. Nothing here knows of fogft.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time

import rclpy
from nav_msgs.srv import GetPlan
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions


class PlanClient(Node):
    def __init__(self, rate_hz: float, limit_s: float, path: str = os.devnull) -> None:
        super().__init__("plan_client")
        self._ends = open(path, "w", buffering=1)  # noqa: SIM115
        self._plan_client = self.create_client(GetPlan, "/plan")
        self._limit_s = limit_s
        self._period_s = 1 / rate_hz
        self.open: dict[int, float] = {}
        self.latencies: list[float] = []
        self.wrong = 0
        self.failed = 0
        self.twice = 0
        self.number = 0
        self.answered_at: list[float] = []
        self.enough = False

    def wait(self) -> bool:
        return self._plan_client.wait_for_service(timeout_sec=60.0)

    def ask(self) -> None:
        self.number += 1
        request = GetPlan.Request()
        request.start.pose.position.x = float(self.number)
        request.goal.pose.position.x = float(self.number) + 0.5
        request.tolerance = float(self.number)
        self.open[self.number] = time.monotonic()
        future = self._plan_client.call_async(request)
        future.add_done_callback(lambda done, number=self.number: self.answer(number, done))

    def answer(self, number: int, future) -> None:
        asked = self.open.pop(number, None)
        if asked is None:
            self.twice += 1
            return
        now = time.monotonic()
        self.latencies.append(now - asked)
        self.answered_at.append(now)
        plan = future.result().plan
        right = (
            len(plan.poses) == 3
            and plan.poses[0].pose.position.x == float(number)
            and plan.poses[2].pose.position.x == float(number) + 0.5
            and plan.header.frame_id == f"{number}"
        )
        self.wrong += not right
        print(json.dumps([asked, now, right]), file=self._ends)

    def run(self, seconds: float) -> None:
        """Ask by a timer and spin, as programs do.

        `rclpy.spin_once` in a loop of one's own takes half a response a turn (the callback is
        a turn of its own), so whoever asks once a turn on a busy machine takes fewer than it
        asks for, and the tenth that waits pushes out the first, whatever answers.
        """
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        end = time.monotonic() + seconds
        self.ask()
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # a node's own is the system's
        timer = self.create_timer(self._period_s, self.ask, clock=steady)
        while time.monotonic() < end and not self.enough:
            # Short: in the wheels' Fast DDS a wait goes by the system's clock. One that began
            # before that was set back lasts until it is that late again, and no timer runs.
            executor.spin_once(timeout_sec=0.05)
            self.give_up()
        timer.cancel()
        while self.open:
            executor.spin_once(timeout_sec=0.05)
            self.give_up()

    def give_up(self) -> None:
        limit = time.monotonic() - self._limit_s
        for number, asked in list(self.open.items()):
            if asked > limit:
                break
            self.failed += 1
            print(json.dumps([asked, None, False]), file=self._ends)
            del self.open[number]

    def summary(self) -> dict:
        ordered = sorted(self.latencies)
        gaps = [b - a for a, b in zip(self.answered_at, self.answered_at[1:], strict=False)]
        return {
            "requests": self.number,
            "answered": len(ordered),
            "failed": self.failed,
            "wrong": self.wrong,
            "twice": self.twice,
            "p50_s": ordered[len(ordered) // 2] if ordered else None,
            "p99_s": ordered[int(len(ordered) * 0.99)] if ordered else None,
            "max_s": ordered[-1] if ordered else None,
            "longest_gap_s": max(gaps, default=None),
        }


def main() -> None:
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    seconds, rate_hz = float(sys.argv[1]), float(sys.argv[2])
    node = PlanClient(rate_hz, float(sys.argv[3]) if len(sys.argv) > 3 else 12.0, *sys.argv[4:5])
    signal.signal(signal.SIGINT, lambda *_: setattr(node, "enough", True))
    if not node.wait():
        print(json.dumps({"error": "the service never appeared"}))
        sys.exit(1)
    print("asking", file=sys.stderr, flush=True)
    node.run(seconds)
    print(json.dumps(node.summary()), flush=True)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
