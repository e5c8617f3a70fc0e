"""The simulated arm picks the box up where it is told, and only there."""

from __future__ import annotations

import numpy as np
import pytest

from tests.examples.loading import modules
from tests.needs import need, needs

# Looked for, not imported: MuJoCo chooses how to draw when it is imported, by what `cell` says.
need("mujoco", "pillow")
with modules("pick", "cell", "tag") as found:
    cells, tag = found


def carried(cell, place, target) -> float:
    """Pick at a place, put down at a target; return how far from it the box lies, in metres."""
    for motion in (cell.scan(1), cell.above(place), cell.down(place)):
        list(motion)
    cell.suck()
    for motion in (cell.above(place), cell.above(target), cell.down(target)):
        list(motion)
    cell.release()
    for motion in (cell.rest(0.3), cell.above(target)):
        list(motion)
    return float(np.linalg.norm(cell.box_at[:2] - target[:2]))


def test_the_box_is_carried_to_the_other_platform():
    cell = cells.Cell()
    place = cell.box_at
    target = np.array([0.68, -0.37, place[2]])
    assert carried(cell, place, target) < 0.02
    assert cell.box_at[2] == pytest.approx(place[2], abs=0.003)


def test_a_wrong_place_leaves_the_box_where_it_is():
    """The check of a cycle can fail: 10 cm beside the box the cup holds nothing."""
    cell = cells.Cell()
    before = cell.box_at
    beside = before + np.array([0.0, 0.1, 0.05])
    assert carried(cell, beside, np.array([0.68, -0.37, before[2]])) > 0.5
    assert cell.box_at == pytest.approx(before, abs=0.002)


def test_camera_and_world_are_inverse():
    cell = cells.Cell()
    list(cell.scan(1))
    seen = cell.in_camera(cell.box_at)
    assert 0.3 < seen[2] < 0.6, "the camera looks down on the box"
    assert cell.in_world(seen) == pytest.approx(cell.box_at)


@needs("egl", "apriltags")
def test_the_camera_sees_the_tag_where_it_is():
    """Rendered by MuJoCo, found by the locator, within 2 mm."""
    cell = cells.Cell()
    list(cell.scan(1))
    image = cell.look()
    with modules("pick", "locator") as (locator,):
        place, _ = locator.Locator().locate(image, cells.CAMERA, tag.ID, tag.EDGE_M)
    assert np.linalg.norm(cell.in_world(place) - cell.box_at) < 0.002
    cell.close()
