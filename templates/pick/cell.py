"""The simulated cell: an arm of a UR10e's size with camera and suction cup, and a tagged box.

MuJoCo moves the joints by position control and holds the box by a weld while the cup sucks. All
that the arm knows of the box comes from the camera; `box_at` is the truth, for checks alone.

Owns: physics, geometry, pictures. Not here: what the arm does when, and who finds the tag.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")  # draws without a screen; read when mujoco is imported

import mujoco
import numpy as np
import tag
from PIL import Image

WIDTH, HEIGHT, FOVY_DEG = 640, 480, 42.6
STEP_S = 0.002
SLICE_S = 0.02  # of simulated time, between two chances to look or to wait
HOME = (0.5, -0.3, 1.6, 0.3, 0.0, 0.0)
ABOVE = np.array([0.0, 0.0, 0.1])
TOUCHING = np.array([0.0, 0.0, 0.002])
SCAN_M = 0.62  # height of the camera when it looks for the box
DOWN = np.array([0.0, 0.0, -1.0])
_FOCUS = HEIGHT / 2 / np.tan(np.radians(FOVY_DEG) / 2)
CAMERA = np.array([[_FOCUS, 0, WIDTH / 2], [0, _FOCUS, HEIGHT / 2], [0, 0, 1]])
_JOINTS = np.arange(7, 13)  # of qpos: the box's seven come first
_SPEEDS = slice(6, 12)


class Cell:
    """See the module. Side +1 is the platform at y > 0, -1 the other one."""

    def __init__(self) -> None:
        texture = io.BytesIO()
        Image.fromarray(tag.picture()).convert("RGB").save(texture, "PNG")
        scene = Path(__file__).with_name("arm.xml").read_text()
        self._model = mujoco.MjModel.from_xml_string(scene, {"tag.png": texture.getvalue()})
        self._data = mujoco.MjData(self._model)
        self._data.qpos[_JOINTS] = HOME
        self._data.ctrl[:] = HOME
        mujoco.mj_forward(self._model, self._data)
        self._renderer: mujoco.Renderer | None = None

    @property
    def time_s(self) -> float:
        """Simulated seconds since the start."""
        return float(self._data.time)

    @property
    def box_at(self) -> np.ndarray:
        """The middle of the tag, truly, in metres."""
        return self._data.site("tag").xpos.copy()

    @property
    def state(self) -> str:
        """All that a picture of the cell needs: numbers, for `show`."""
        return " ".join(f"{number:.5g}" for number in self._data.qpos)

    def show(self, state: str) -> None:
        """Put everything where it was when `state` was told."""
        self._data.qpos[:] = [float(number) for number in state.split()]
        mujoco.mj_forward(self._model, self._data)

    # -- moving -----------------------------------------------------------------------------

    def scan(self, side: int) -> Iterator[None]:
        """Go where the camera sees a platform. Yields every `SLICE_S`, as all motions do."""
        near = [0.5 * side, *HOME[1:]]
        return self._go(self._reach("eye", np.array([0.68, 0.4 * side, SCAN_M]), near), 2.0)

    def above(self, place: np.ndarray) -> Iterator[None]:
        """Bring the cup over a place."""
        return self._go(self._reach("cup", place + ABOVE), 1.2)

    def down(self, place: np.ndarray) -> Iterator[None]:
        """Lower the cup onto a place."""
        return self._go(self._reach("cup", place + TOUCHING), 0.8)

    def rest(self, seconds: float) -> Iterator[None]:
        """Stay as it is."""
        return self._go(self._data.ctrl.copy(), seconds)

    def suck(self) -> None:
        """Hold the box as it now lies to the wrist, if the cup touches it; else hold nothing."""
        if np.linalg.norm(self._data.site("cup").xpos - self.box_at) > 0.05:
            return
        wrist, box = self._data.body("wrist"), self._data.body("box")
        turn, back = np.zeros(4), np.zeros(4)
        mujoco.mju_negQuat(back, wrist.xquat)
        mujoco.mju_mulQuat(turn, back, box.xquat)
        weld = self._model.equality("suction")
        weld.data[0:3] = 0
        weld.data[3:6] = wrist.xmat.reshape(3, 3).T @ (box.xpos - wrist.xpos)
        weld.data[6:10] = turn
        self._data.eq_active[weld.id] = 1

    def release(self) -> None:
        """Let go."""
        self._data.eq_active[self._model.equality("suction").id] = 0

    def _go(self, angles: np.ndarray, seconds: float) -> Iterator[None]:
        """Move the joints to angles on a smooth ramp, which ends before the motion does."""
        begin = self._data.ctrl.copy()
        steps, ramp = round(seconds / STEP_S), 0.6 * seconds / STEP_S
        for step in range(steps):
            part = min(1.0, step / ramp)
            self._data.ctrl[:] = begin + (angles - begin) * part * part * (3 - 2 * part)
            mujoco.mj_step(self._model, self._data)
            if step % round(SLICE_S / STEP_S) == 0:
                yield

    def _reach(self, site: str, place: np.ndarray, near: list[float] | None = None) -> np.ndarray:
        """Return joint angles that bring a site to a place, looking down: damped least squares."""
        trial = mujoco.MjData(self._model)
        trial.qpos[:] = self._data.qpos
        if near is not None:
            trial.qpos[_JOINTS] = near
        shift, turn = np.zeros((3, self._model.nv)), np.zeros((3, self._model.nv))
        index = self._model.site(site).id
        for _ in range(200):
            mujoco.mj_kinematics(self._model, trial)
            mujoco.mj_comPos(self._model, trial)
            mujoco.mj_jacSite(self._model, trial, shift, turn, index)
            facing = trial.site_xmat[index].reshape(3, 3)[:, 1]
            miss = np.concatenate([place - trial.site_xpos[index], np.cross(facing, DOWN)])
            if np.linalg.norm(miss) < 1e-5:
                break
            j = np.concatenate([shift[:, _SPEEDS], turn[:, _SPEEDS]])
            change = j.T @ np.linalg.solve(j @ j.T + 1e-4 * np.eye(6), miss)
            trial.qpos[_JOINTS] += np.clip(change, -0.2, 0.2)
        return trial.qpos[_JOINTS].copy()

    # -- seeing -----------------------------------------------------------------------------

    def look(self) -> np.ndarray:
        """Return what the wrist camera sees: 480 x 640 bytes, grey."""
        rgb = self._draw("wrist").astype(float)
        return (rgb @ [0.299, 0.587, 0.114]).round().astype(np.uint8)

    def in_world(self, seen: np.ndarray) -> np.ndarray:
        """Return where a point is that the wrist camera sees at `seen` in its optical frame."""
        camera = self._data.camera("wrist")
        return camera.xmat.reshape(3, 3) @ (np.array([1, -1, -1]) * seen) + camera.xpos

    def in_camera(self, place: np.ndarray) -> np.ndarray:
        """Return where the wrist camera sees a point of the world: the inverse of `in_world`."""
        camera = self._data.camera("wrist")
        turned: np.ndarray = camera.xmat.reshape(3, 3).T @ (place - camera.xpos)
        return np.array([1, -1, -1]) * turned

    def overview(self) -> np.ndarray:
        """Return a picture of the whole cell: 480 x 640 x 3 bytes."""
        camera = mujoco.MjvCamera()
        camera.lookat[:] = [0.4, 0, 0.35]
        camera.distance, camera.elevation, camera.azimuth = 2.3, -25, 150
        return self._draw(camera)

    def close(self) -> None:
        """Give back what draws the pictures."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _draw(self, camera: str | mujoco.MjvCamera) -> np.ndarray:
        if self._renderer is None:
            self._renderer = mujoco.Renderer(self._model, HEIGHT, WIDTH)
        self._renderer.update_scene(self._data, camera)
        return self._renderer.render()
