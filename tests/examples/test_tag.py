"""The tag locator tells the pose from which an image was rendered, and nothing where no tag is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.examples.loading import modules
from tests.needs import need

need("apriltags")
with modules("pick", "locator", "rotation", "tag") as found:
    locator, rotation, tag = found

K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])


def turned(yaw: float, tilt: float, towards: float) -> np.ndarray:
    """Return a rotation: about the line of sight, then tilted by so much in a direction."""
    axis = np.array([np.cos(towards), np.sin(towards), 0])
    cross = np.array([[0, 0, axis[1]], [0, 0, -axis[0]], [-axis[1], axis[0], 0]])
    tilted = np.eye(3) + np.sin(tilt) * cross + (1 - np.cos(tilt)) * cross @ cross
    cos, sin = np.cos(yaw), np.sin(yaw)
    return tilted @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def rendered(rotated: np.ndarray, place: np.ndarray, seed: int) -> np.ndarray:
    """Cast a ray through every quarter of every pixel onto the plane of the tag; add noise."""
    chance = np.random.default_rng(seed)
    cells, edge = tag.picture(1), tag.WITH_WHITE_M
    fine = (np.arange(4) - 1.5) / 4
    x = (np.arange(640)[:, None] + 0.5 + fine).ravel()
    y = (np.arange(480)[:, None] + 0.5 + fine).ravel()
    to_plane = np.linalg.inv(K @ np.column_stack([rotated[:, 0], rotated[:, 1], place]))
    u, v, w = np.tensordot(to_plane, np.stack([*np.meshgrid(x, y), np.ones((y.size, x.size))]), 1)
    column, row = (u / w / edge + 0.5) * 10, (v / w / edge + 0.5) * 10
    inside = (column >= 0) & (column < 10) & (row >= 0) & (row < 10)
    image = np.full(u.shape, 120.0)
    image[inside] = cells[row[inside].astype(int), column[inside].astype(int)]
    image = image.reshape(480, 4, 640, 4).mean(axis=(1, 3)) * 0.8 + 20
    return np.clip(image + chance.normal(0, 3, image.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("seed", range(6))
def test_a_known_pose_is_told(seed):
    """Within 3 mm and 2 degrees at up to 0.7 m, tilted by 10 to 40 degrees, with noise."""
    chance = np.random.default_rng(seed)
    angles = chance.uniform(-np.pi, np.pi), chance.uniform(0.17, 0.7), chance.uniform(0, 6.28)
    away = chance.uniform(0.35, 0.7)
    place = np.array([*chance.uniform(-0.15, 0.15, 2) * away, away])
    right = turned(*angles)
    seen = locator.Locator().locate(rendered(right, place, seed), K, tag.ID, tag.EDGE_M)
    assert seen is not None
    assert np.linalg.norm(seen[0] - place) < 0.003
    cosine = (np.trace(seen[1].T @ right) - 1) / 2
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) < 2


def test_no_tag_another_tag_and_another_size():
    """Nothing is found where it is not; a tag taken for twice as large is twice as far."""
    place, detector = np.array([0.02, -0.03, 0.5]), locator.Locator()
    image = rendered(turned(0.3, 0.2, 1.0), place, 0)
    assert detector.locate(np.full_like(image, 120), K, tag.ID, tag.EDGE_M) is None
    assert detector.locate(image, K, tag.ID + 1, tag.EDGE_M) is None
    twice = detector.locate(image, K, tag.ID, 2 * tag.EDGE_M)
    assert twice[0] == pytest.approx(2 * place, abs=0.006)


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(0, 6.2))
def test_a_rotation_comes_back_from_its_quaternion(yaw, tilt, towards):
    matrix = turned(yaw, tilt, towards)
    quaternion = rotation.quaternion(matrix)
    assert quaternion[3] >= 0
    assert np.linalg.norm(quaternion) == pytest.approx(1)
    assert rotation.matrix(*quaternion) == pytest.approx(matrix, abs=1e-9)
