"""The AprilTag on the box: its picture, and its size.

Tag 7 of family 36h11, a black square of 8 x 8 cells with a white edge of one cell around it.
"""

from __future__ import annotations

import numpy as np

FAMILY = "tag36h11"
ID = 7
CELLS = ("00000000", "00001000", "00001100", "00101000", "01011100", "00001110", "00101000",
         "00000000")  # fmt: skip
EDGE_M = 0.1  # of the black square
WITH_WHITE_M = EDGE_M * 10 / 8


def picture(cell_px: int = 40) -> np.ndarray:
    """Return the tag with its white edge, as bytes: 0 black, 255 white."""
    black = np.array([[255 * int(cell) for cell in row] for row in CELLS], np.uint8)
    return np.kron(np.pad(black, 1, constant_values=255), np.ones((cell_px, cell_px), np.uint8))
