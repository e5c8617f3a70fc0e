"""Find an AprilTag in an image, and its pose from the size it is known to have. No ROS in here."""

from __future__ import annotations

import numpy as np
import pupil_apriltags
from tag import FAMILY


class _Detector(pupil_apriltags.Detector):
    def __del__(self) -> None:
        """Free nothing: the library's own way crashes now and then, and a process needs but one."""


class Locator:
    """The detector, on one thread."""

    def __init__(self) -> None:
        self._detector = _Detector(
            families=FAMILY, nthreads=1, quad_decimate=2.0, refine_edges=True
        )

    def locate(
        self, mono: np.ndarray, k: np.ndarray, id: int, size_m: float
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return a tag's place (metres) and rotation matrix as the camera sees it, or None.

        Args:
            mono: The image: height x width bytes.
            k: The camera's matrix, 3 x 3.
            id: Which tag; of several copies of it, the one that is read best.
            size_m: Edge of its black square.
        """
        lens = (k[0, 0], k[1, 1], k[0, 2], k[1, 2])
        seen = self._detector.detect(
            np.ascontiguousarray(mono), estimate_tag_pose=True, camera_params=lens, tag_size=size_m
        )
        right = [each for each in seen if each.tag_id == id]
        if not right:
            return None
        best = max(right, key=lambda each: each.decision_margin)
        return best.pose_t.ravel(), best.pose_R
