"""A simulated arm that picks a box up and puts it elsewhere, again and again, by what it is told.

An ordinary ROS 2 client of `/locate_tag`. The arm scans a platform, asks where the tag in the
image is, picks the box up there, and puts it down at a random place of the other platform. It
also asks about what the camera sees while it moves, at a steady pace.

A cycle fails if its scan gets no answer in time, the tag is not found, or the box does not end
within 2 cm of where it was to go. A tag that is reported more than 1 cm from the truth is wrong.
Runs for a number of cycles, or until Ctrl-C; then it finishes the cycle, prints one JSON object,
and exits with 1 if a cycle or request failed or an answer was wrong.
"""

from __future__ import annotations

import argparse
import csv
import json
import random
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rclpy
import tag
from cell import CAMERA, HEIGHT, SLICE_S, WIDTH, Cell
from pick_interfaces.srv import LocateTag
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

KEEP_ALL = QoSProfile(history=QoSHistoryPolicy.KEEP_ALL)
PLACED_M = 0.02
SEEN_M = 0.01
FIELDS = ("began_at", "cycle", "scan", "latency_s", "answered", "found", "error_m", "state")


class CycleError(Exception):
    """Why a cycle failed."""


@dataclass
class Asked:
    """A request on its way: when it was sent, and where the tag truly was."""

    began_at: float  # seconds since the epoch
    began: float
    scan: bool
    future: Future
    state: str  # of the cell
    truth: np.ndarray


class Samples:
    """A line for each request, written when it has ended; nowhere where there is no path."""

    def __init__(self, path: Path | None) -> None:
        self._file = path.open("w", newline="", buffering=1) if path else None
        if self._file:
            self._file.write(",".join(FIELDS) + "\n")

    def write(self, row: dict[str, object]) -> None:
        if self._file:
            csv.DictWriter(self._file, FIELDS, lineterminator="\n").writerow(row)

    def close(self) -> None:
        if self._file:
            self._file.close()


class Picker(Node):
    """The arm's program, and what it counts."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__("pick_client")
        self._options = options
        self._cell = Cell()
        self._chance = random.Random(options.seed)
        self._client = self.create_client(LocateTag, options.service, qos_profile=KEEP_ALL)
        self._open: Asked | None = None
        self._answer: LocateTag.Response | None = None
        self._next_at = self._wall = 0.0
        self._samples = Samples(options.samples)
        self.rows: list[dict[str, object]] = []
        self.cycles = 0
        self.faults: list[str] = []
        self.ending = False

    def wait(self) -> bool:
        return self._client.wait_for_service(timeout_sec=self._options.wait_s)

    def run(self) -> None:
        """Return after the last cycle, or that during which the end was asked for."""
        side = 1
        self._wall = time.monotonic()
        while not self.ending and self.cycles != self._options.cycles:
            self.cycles += 1
            try:
                self._cycle(side)
            except CycleError as error:
                self.faults.append(f"cycle {self.cycles}: {error}")
                self._cell.release()
            if abs(self._cell.box_at[1] + 0.4 * side) < 0.3:
                side = -side  # it lies where it was to go

    def _cycle(self, side: int) -> None:
        self._do(self._cell.scan(side))
        place = self._scanned()
        x = self._chance.uniform(0.65, 0.75)
        y = -side * self._chance.uniform(0.33, 0.47)
        target = np.array([x, y, place[2]])
        for motion in (self._cell.above, self._cell.down):
            self._do(motion(place))
        self._cell.suck()
        for motion, to in ((self._cell.above, place), (self._cell.above, target)):
            self._do(motion(to))
        self._do(self._cell.down(target))
        self._cell.release()
        self._do(self._cell.rest(0.3))
        self._do(self._cell.above(target))
        off = float(np.linalg.norm(self._cell.box_at[:2] - target[:2]))
        if not off <= PLACED_M:
            raise CycleError(f"the box lies {off * 100:.1f} cm from where it was to go")

    def _scanned(self) -> np.ndarray:
        """Ask about what the camera sees now; return where the tag is, in metres."""
        while self._open:
            self._spin()
        self._ask(scan=True)
        while self._open:
            self._spin()
        self._wall = time.monotonic()  # the arm stood still: what was lost is not made up for
        if self._answer is None:
            raise CycleError("the scan got no answer")
        if not self._answer.found:
            raise CycleError("the scan found no tag")
        return self._cell.in_world(_place(self._answer))

    def _do(self, motion: Iterator[None]) -> None:
        """Carry a motion out at the pace that was asked for, with an eye on the camera."""
        for _ in motion:
            self._wall += SLICE_S / self._options.pace
            if time.monotonic() >= self._next_at and not self._open:
                self._ask(scan=False)
            self._spin(max(0.0, self._wall - time.monotonic()))
            self._wall = max(self._wall, time.monotonic() - 0.5)

    def _ask(self, *, scan: bool) -> None:
        asked = LocateTag.Request(k=CAMERA.ravel(), id=tag.ID, size_m=tag.EDGE_M)
        image = asked.image
        image.header.frame_id, image.encoding = "wrist_camera", "mono8"
        image.width, image.height, image.step = WIDTH, HEIGHT, WIDTH
        image.data = self._cell.look().tobytes()
        truth = self._cell.in_camera(self._cell.box_at)
        self._next_at = time.monotonic() + self._options.period_s
        began_at, began = time.time(), time.perf_counter()
        future = self._client.call_async(asked)
        self._open = Asked(began_at, began, scan, future, self._cell.state, truth)

    def _spin(self, seconds: float = 0.05) -> None:
        """Let ROS work for so long; take an answer, or give a request up."""
        end = time.monotonic() + seconds
        while True:
            left = end - time.monotonic()
            rclpy.spin_once(self, timeout_sec=max(0.0, left))
            if self._open:
                took_s = time.perf_counter() - self._open.began
                if self._open.future.done():
                    self._took(self._open.future.result(), took_s)
                    return
                if took_s > self._options.timeout_s:
                    self._client.remove_pending_request(self._open.future)
                    self._took(None, took_s)
            if left <= 0:
                return

    def _took(self, answer: LocateTag.Response | None, took_s: float) -> None:
        asked, self._open, self._answer = self._open, None, answer
        assert asked is not None
        found = answer is not None and answer.found
        error_m = float(np.linalg.norm(_place(answer) - asked.truth)) if found else ""
        values = (asked.began_at, self.cycles, int(asked.scan), round(took_s, 6))
        values = (*values, int(answer is not None), int(found), error_m, asked.state)
        self.rows.append(dict(zip(FIELDS, values, strict=True)))
        self._samples.write(self.rows[-1])

    def close(self) -> None:
        self._cell.close()
        self._samples.close()

    def summary(self) -> dict[str, object]:
        errors = [row["error_m"] for row in self.rows if row["error_m"] != ""]
        return {
            "cycles": self.cycles,
            "failed_cycles": len(self.faults),
            "requests": len(self.rows),
            "failed": sum(not row["answered"] for row in self.rows),
            "found": len(errors),
            "wrong": sum(error > SEEN_M for error in errors),
            "faults": self.faults[:5],
        }


def _place(answer: LocateTag.Response) -> np.ndarray:
    at = answer.pose.position
    return np.array([at.x, at.y, at.z])


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cycles", type=int, default=-1, help="how many; until Ctrl-C unless told")
    parser.add_argument("--pace", type=float, default=1.0, help="simulated seconds a second")
    parser.add_argument("--period-s", type=float, default=0.2, help="from request to request")
    parser.add_argument("--timeout-s", type=float, default=10.0, help="then one has failed")
    parser.add_argument("--wait-s", type=float, default=30.0, help="for the service to appear")
    parser.add_argument("--service", default="/locate_tag", help="name of the service")
    parser.add_argument("--seed", type=int, default=1, help="seed of the places")
    parser.add_argument("--samples", type=Path, help="write a line for each request to this file")
    return parser.parse_args(remove_ros_args(sys.argv)[1:])


def main() -> int:
    options = arguments()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        picker = Picker(options)
        signal.signal(signal.SIGINT, lambda *_: setattr(picker, "ending", True))
        if not picker.wait():
            print(f"no service {options.service} within {options.wait_s} s", file=sys.stderr)
            return 1
        print("moving", file=sys.stderr, flush=True)
        picker.run()
        picker.close()
        summary = picker.summary()
        print(json.dumps(summary, indent=2), flush=True)
        return 1 if summary["failed_cycles"] or summary["failed"] or summary["wrong"] else 0
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(main())
