"""The scene that the planner plans in and the client checks against: a floor with boxes.

Three rooms side by side, joined by two doors barely wider than the robot, with clutter in
each. The same seed gives the same scene everywhere, so that a robot can check what the
cloud answered. Lengths in metres.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from itertools import pairwise

SIZE = 10.0
ROBOT_RADIUS = 0.2
# The planner keeps this much more distance than it must: it tests its motions at points,
# and between two points a corner may come closer.
MARGIN = 0.04
DOOR = 0.58
WALL = 0.3
CLUTTER = 15
Point = tuple[float, float]


@dataclass(frozen=True)
class Box:
    """An obstacle: an upright rectangle."""

    x0: float
    y0: float
    x1: float
    y1: float

    def grown(self, by: float) -> Box:
        return Box(self.x0 - by, self.y0 - by, self.x1 + by, self.y1 + by)

    def holds(self, x: float, y: float) -> bool:
        return self.x0 < x < self.x1 and self.y0 < y < self.y1

    def cut_by(self, a: Point, b: Point) -> bool:
        """Whether the segment from a to b passes through the inside of this box."""
        enter, leave = 0.0, 1.0
        for start, end, low, high in (
            (a[0], b[0], self.x0, self.x1),
            (a[1], b[1], self.y0, self.y1),
        ):
            step = end - start
            if step == 0:
                if not low < start < high:
                    return False
                continue
            first, last = sorted(((low - start) / step, (high - start) / step))
            enter, leave = max(enter, first), min(leave, last)
        return enter < leave


class Scene:
    """Boxes on a square floor, made from a seed."""

    def __init__(self, seed: int = 7) -> None:
        rng = random.Random(seed)
        self.boxes: list[Box] = []
        doors: list[Point] = []
        for x in (SIZE / 3, 2 * SIZE / 3):
            door = rng.uniform(1.0, SIZE - 1.0 - DOOR)
            doors.append((x, door + DOOR / 2))
            self.boxes.append(Box(x - WALL / 2, 0.0, x + WALL / 2, door))
            self.boxes.append(Box(x - WALL / 2, door + DOOR, x + WALL / 2, SIZE))
        while len(self.boxes) < 4 + CLUTTER:
            centre = rng.uniform(0.8, SIZE - 0.8), rng.uniform(0.8, SIZE - 0.8)
            if min(math.dist(centre, door) for door in doors) < 1.4:
                continue  # the doors are hard enough
            wide, high = rng.uniform(0.1, 0.3), rng.uniform(0.1, 0.5)
            x, y = centre
            self.boxes.append(Box(x - wide, y - high, x + wide, y + high))

    def solids(self, distance: float) -> list[Box]:
        """The boxes grown by a distance: where the robot's centre may not be."""
        return [box.grown(distance) for box in self.boxes]

    def free_point(self, rng: random.Random, room: int) -> Point:
        """A place in a room (0, 1 or 2) where the robot fits, with the planner's margin."""
        distance = ROBOT_RADIUS + MARGIN
        solids = self.solids(distance)
        while True:
            x = rng.uniform(room, room + 1) * SIZE / 3
            y = rng.uniform(distance, SIZE - distance)
            inside = distance <= x <= SIZE - distance
            if inside and not any(box.holds(x, y) for box in solids):
                return x, y

    def fault(self, path: list[Point], start: Point, goal: Point, tolerance: float = 1e-3) -> str:
        """Say what is wrong with a path from start to goal; nothing if it is right."""
        if not path:
            return "the path is empty"
        if not math.dist(path[0], start) <= tolerance:  # so that NaN is wrong
            return f"it starts at {path[0]}, not at {start}"
        if not math.dist(path[-1], goal) <= tolerance:
            return f"it ends at {path[-1]}, not at {goal}"
        solids = self.solids(ROBOT_RADIUS)
        for a, b in pairwise(path):
            for x, y in (a, b):
                if not (0 <= x <= SIZE and 0 <= y <= SIZE):
                    return f"{(x, y)} is off the floor"
            if any(box.cut_by(a, b) for box in solids):
                return f"the segment {a} - {b} cuts an obstacle"
        return ""
