"""SSD-MobileNetV2 by LiteRT: from an image to labelled boxes.

The network says, for each of 1917 anchors, how likely it is each class and how the object's box
differs from the anchor. This module lays the anchors out, turns that into boxes and keeps the
best of those that overlap. Decoding needs no weights, and is tested without.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

MODEL = "ssd_mobilenet_v2_oidv4.tflite"
LABELS = "labels.txt"
NAME = "SSD-MobileNetV2, Open Images V4, trained"
SIDE = 300  # pixels of the network's square input
_GRIDS = (19, 10, 5, 3, 2, 1)
_SCALES = (0.2, 0.35, 0.5, 0.65, 0.8, 0.95, 1.0)
_OVERLAP = 0.5  # two boxes of a class that overlap more are one object


@dataclass(frozen=True)
class Found:
    """One object: its class, how sure the network is, and x, y, width, height in pixels."""

    label: str
    score: float
    box: tuple[float, float, float, float]


def anchors() -> np.ndarray:
    """Return the centre (y, x) and size (height, width) of every anchor, in parts of the image."""
    made = []
    for level, cells in enumerate(_GRIDS):
        scale, finer = _SCALES[level], (_SCALES[level] * _SCALES[level + 1]) ** 0.5
        shapes = [(scale, ratio) for ratio in (1.0, 2.0, 0.5, 3.0, 1 / 3)] + [(finer, 1.0)]
        if level == 0:
            shapes = [(0.1, 1.0), (scale, 2.0), (scale, 0.5)]
        for row in range(cells):
            for column in range(cells):
                centre = ((row + 0.5) / cells, (column + 0.5) / cells)
                made += [(*centre, s / ratio**0.5, s * ratio**0.5) for s, ratio in shapes]
    return np.array(made)


ANCHORS = anchors()


def decode(
    offsets: np.ndarray,
    logits: np.ndarray,
    labels: list[str],
    size: tuple[int, int],
    threshold: float,
) -> list[Found]:
    """Turn the network's raw answer into objects, the surest first.

    Args:
        offsets: 1917 times y, x, height, width, as the network encodes them.
        logits: 1917 times one number a class; class 0 is the background.
        labels: The classes' names.
        size: Width and height of the image, in pixels.
        threshold: The least score.
    """
    scores = 1 / (1 + np.exp(-logits[:, 1:].astype(float)))
    classes = scores.argmax(axis=1)
    best = scores[np.arange(len(scores)), classes]
    sure = np.flatnonzero(best >= threshold)
    sure = sure[np.argsort(-best[sure], kind="stable")]
    near, away = ANCHORS[sure], offsets[sure].astype(float)
    centres = away[:, :2] / 10 * near[:, 2:] + near[:, :2]
    sizes = near[:, 2:] * np.exp(away[:, 2:] / 5)
    corners = np.concatenate([centres - sizes / 2, sizes], axis=1)[:, [1, 0, 3, 2]]
    boxes = corners * np.array([*size, *size])
    kept: list[Found] = []
    for index, box in zip(sure, boxes, strict=True):
        found = Found(labels[classes[index] + 1], float(best[index]), tuple(map(float, box)))
        same = (other for other in kept if other.label == found.label)
        if all(overlap(found.box, other.box) <= _OVERLAP for other in same):
            kept.append(found)
    return kept


def overlap(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Return the area that two boxes share, in parts of the area that they cover."""
    wide = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    high = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    if wide <= 0 or high <= 0:
        return 0.0
    return wide * high / (a[2] * a[3] + b[2] * b[3] - wide * high)


class Detector:
    """The network with its weights, on one thread. Holds nothing from image to image."""

    def __init__(self, weights: Path) -> None:
        from ai_edge_litert.interpreter import Interpreter

        self._labels = (weights / LABELS).read_text().split("\n")
        self._network = Interpreter(str(weights / MODEL), num_threads=1)
        self._network.allocate_tensors()
        self._input = self._network.get_input_details()[0]["index"]
        self._outputs = [each["index"] for each in self._network.get_output_details()]

    def detect(self, rgb: np.ndarray, threshold: float) -> list[Found]:
        """Return what is in an image: height x width x 3 bytes."""
        from PIL import Image

        small = Image.fromarray(rgb).resize((SIDE, SIDE), Image.Resampling.BILINEAR)
        values = np.asarray(small, np.float32) / 127.5 - 1
        self._network.set_tensor(self._input, values[None])
        self._network.invoke()
        offsets, logits = (self._network.get_tensor(index)[0] for index in self._outputs)
        size = rgb.shape[1], rgb.shape[0]
        return decode(offsets, logits, self._labels, size, threshold)
