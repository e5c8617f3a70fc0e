"""The planner example's scene: it is solvable, and its check finds what is wrong."""

from __future__ import annotations

import importlib.util
import math
import random
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft import template_files
from tests.needs import needs


def load(name):
    spec = importlib.util.spec_from_file_location(
        f"planner_{name}", template_files.folder() / "planner" / f"{name}.py"
    )
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


scene = load("scene")
metres = st.floats(-2, 12).map(lambda metre: round(metre, 6))
points = st.tuples(metres, metres)
boxes = st.tuples(points, st.floats(0.1, 3), st.floats(0.1, 3)).map(
    lambda b: scene.Box(b[0][0], b[0][1], b[0][0] + b[1], b[0][1] + b[2])
)


@given(box=boxes, a=points, b=points)
def test_a_segment_with_a_point_inside_is_cut(box, a, b):
    """No point of a segment that is not cut lies well inside the box."""
    inner = box.grown(-0.01)
    steps = [t / 200 for t in range(201)]
    inside = any(inner.holds(a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])) for t in steps)
    if inside:
        assert box.cut_by(a, b)


@given(box=boxes, a=points, b=points)
def test_a_segment_is_cut_either_way_round(box, a, b):
    """Crossing a box does not depend on the direction, and only what reaches it crosses."""
    assert box.cut_by(a, b) == box.cut_by(b, a)
    if box.cut_by(a, b):
        assert min(a[0], b[0]) < box.x1
        assert max(a[0], b[0]) > box.x0
        assert min(a[1], b[1]) < box.y1
        assert max(a[1], b[1]) > box.y0


def test_the_same_seed_gives_the_same_scene():
    """Robot and cloud make the scene each for themselves."""
    assert scene.Scene(3).boxes == scene.Scene(3).boxes
    assert scene.Scene(3).boxes != scene.Scene(4).boxes


@pytest.mark.parametrize("seed", range(10))
def test_free_points_are_free_and_in_their_room(seed):
    world = scene.Scene(seed)
    rng = random.Random(seed)
    solids = world.solids(scene.ROBOT_RADIUS + scene.MARGIN)
    for room in (0, 1, 2):
        x, y = world.free_point(rng, room)
        assert room * scene.SIZE / 3 <= x <= (room + 1) * scene.SIZE / 3
        assert not any(box.holds(x, y) for box in solids)


class TestFault:
    """A hand-made way in a scene with one wall, and what can be wrong with it."""

    @pytest.fixture
    def world(self):
        world = scene.Scene(1)
        world.boxes = [scene.Box(4, 0, 5, 6)]
        return world

    way = [(1.0, 1.0), (3.0, 7.0), (6.0, 7.0), (9.0, 1.0)]

    def test_a_right_way(self, world):
        assert world.fault(self.way, self.way[0], self.way[-1]) == ""

    def test_no_way(self, world):
        assert world.fault([], (1, 1), (9, 1)) == "the path is empty"

    def test_the_way_of_another_request(self, world):
        assert world.fault(self.way, (1.0, 1.1), self.way[-1]).startswith("it starts at")
        assert world.fault(self.way, self.way[0], (9.0, 1.1)).startswith("it ends at")

    def test_through_the_wall(self, world):
        straight = [self.way[0], self.way[-1]]
        assert world.fault(straight, *straight).endswith("cuts an obstacle")

    def test_too_near_to_the_wall(self, world):
        near = [(1.0, 6.1), (9.0, 6.1)]
        assert world.fault(near, *near).endswith("cuts an obstacle")
        far = [(1.0, 6.21), (9.0, 6.21)]
        assert world.fault(far, *far) == ""

    def test_off_the_floor(self, world):
        assert world.fault([(1, 1), (1, 11)], (1, 1), (1, 11)) == "(1, 11) is off the floor"

    def test_not_a_number(self, world):
        nowhere = [self.way[0], (math.nan, 7.0), *self.way[1:]]
        assert world.fault(nowhere, self.way[0], self.way[-1]) != ""
        assert world.fault([(math.nan, 1.0)], (1.0, 1.0), (1.0, 1.0)) != ""


@needs("ompl", "rclpy")
@pytest.mark.parametrize("seed", range(4))
def test_the_planner_finds_right_ways(seed, monkeypatch):
    """The service's planner passes the client's check, in scenes of any seed."""
    monkeypatch.setitem(sys.modules, "scene", scene)
    service = load("planner_service")
    world = scene.Scene(seed)
    rng = random.Random(seed)
    planner = service.Planner(world, limit_s=30.0)
    for rooms in ((0, 2), (2, 0), (1, 1)):
        start, goal = (world.free_point(rng, room) for room in rooms)
        assert world.fault(planner.plan(start, goal), start, goal) == ""


@needs("ompl", "rclpy")
def test_a_start_inside_a_wall_has_no_way(monkeypatch):
    """The answer is an empty path, not an exception and not a way through the wall."""
    monkeypatch.setitem(sys.modules, "scene", scene)
    service = load("planner_service")
    world = scene.Scene(1)
    box = world.boxes[0]
    inside = ((box.x0 + box.x1) / 2, (box.y0 + box.y1) / 2)
    assert service.Planner(world, limit_s=0.2).plan(inside, (1.0, 1.0)) == []


@needs("rclpy")
def test_percentiles_are_values_that_occurred(monkeypatch):
    """The client's percentiles need no interpolation: each is a latency that was seen."""
    monkeypatch.setitem(sys.modules, "scene", scene)
    client = load("planner_client")
    hundred = [float(n) for n in range(1, 101)]
    assert [client.percentile(hundred, p) for p in (50, 99, 100)] == [50, 99, 100]
    assert client.percentile([3.0], 99) == 3.0
    assert client.percentile([], 50) is None
