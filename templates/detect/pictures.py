"""Pictures to ask about, drawn anew each time: what is in one, and where, is known.

Three things that the detector's classes have, drawn plainly at a random place and size. So an
answer can be checked, and nobody's photographs are needed.
"""

from __future__ import annotations

import io
import math
import random
from collections.abc import Callable
from dataclasses import dataclass

from PIL import Image, ImageDraw, ImageFilter

SIZE = (640, 480)
_DARK, _GLASS = (28, 28, 30), (150, 190, 210)
Box = tuple[float, float, float, float]
Point = tuple[float, float]


@dataclass(frozen=True)
class Picture:
    """An image, the class of what is in it, and its box: x, y, width, height in pixels."""

    image: Image.Image
    label: str
    box: Box

    def jpeg(self) -> bytes:
        """Return the image as a camera would send it."""
        out = io.BytesIO()
        self.image.save(out, "JPEG", quality=90)
        return out.getvalue()


class _Pen:
    """Draws in the coordinates of the thing: 0 to 100 over its width, down likewise."""

    def __init__(self, image: Image.Image, x: float, y: float, unit: float) -> None:
        self._draw = ImageDraw.Draw(image)
        self._x, self._y, self._unit = x, y, unit

    def at(self, x: float, y: float) -> tuple[float, float]:
        return self._x + x * self._unit, self._y + y * self._unit

    def polygon(self, points: list[Point], fill: tuple[int, int, int]) -> None:
        self._draw.polygon([self.at(*point) for point in points], fill=fill)

    def rectangle(
        self, corner: Point, other: Point, fill: tuple[int, int, int], *, r: float = 0
    ) -> None:
        place = (*self.at(*corner), *self.at(*other))
        self._draw.rounded_rectangle(place, r * self._unit, fill=fill)

    def disc(self, x: float, y: float, r: float, fill: tuple[int, int, int]) -> None:
        self._draw.ellipse((*self.at(x - r, y - r), *self.at(x + r, y + r)), fill=fill)

    def ring(self, x: float, y: float, r: float, width: float) -> None:
        place = (*self.at(x - r, y - r), *self.at(x + r, y + r))
        self._draw.ellipse(place, outline=_DARK, width=max(2, round(width * self._unit)))

    def line(self, a: Point, b: Point, width: float, fill: tuple[int, ...]) -> None:
        ends = (*self.at(*a), *self.at(*b))
        self._draw.line(ends, fill=fill, width=max(1, round(width * self._unit)))


def _laptop(pen: _Pen) -> None:
    pen.polygon([(12, 45), (88, 45), (100, 65), (0, 65)], (160, 160, 165))
    for row in range(5):
        wide, left = 5.5 + row * 0.25, 17 - row * 1.5
        for column in range(12):
            x, y = left + column * wide, 47.5 + row * 2.8
            pen.rectangle((x, y), (x + wide * 0.77, y + 2), (30, 30, 30))
    pen.rectangle((15, 0), (85, 45), _DARK)
    pen.rectangle((18, 3), (82, 42), (70, 130, 190))


def _car(pen: _Pen) -> None:
    red = (190, 20, 25)
    pen.rectangle((0, 17.5), (100, 41), red, r=7)
    pen.polygon([(18.6, 18.6), (32.5, 0), (69.7, 0), (86, 18.6)], red)
    pen.polygon([(23, 17.5), (34.4, 3), (50, 3), (50, 17.5)], _GLASS)
    pen.polygon([(52.8, 17.5), (52.8, 3), (67.9, 3), (80, 17.5)], _GLASS)
    for wheel in (23, 76.5):
        pen.disc(wheel, 41.4, 11.2, (20, 20, 20))
        pen.disc(wheel, 41.4, 5.6, (180, 180, 185))


def _bicycle(pen: _Pen) -> None:
    red = (200, 20, 20)
    for x in (20.0, 80.0):
        pen.ring(x, 40, 20, 2)
        for turn in range(24):
            angle = turn * math.tau / 24
            rim = (x + 19 * math.cos(angle), 40 + 19 * math.sin(angle))
            pen.line((x, 40), rim, 0.25, (90, 90, 90))
    frame = [((20, 40), (35, 12)), ((35, 12), (67.5, 12)), ((67.5, 12), (47.5, 40))]
    frame += [((47.5, 40), (20, 40)), ((47.5, 40), (32.5, 7)), ((80, 40), (66, 5))]
    for a, b in frame:
        pen.line(a, b, 2.3, red)
    pen.rectangle((25, 5), (40, 8), _DARK, r=1.5)
    pen.line((62, 3), (72, 5), 2, _DARK)


# Class: how it is drawn, its height for a width of 100, and the colours behind and below it.
_THINGS: dict[str, tuple[Callable[[_Pen], None], float, tuple[int, ...], tuple[int, ...]]] = {
    "Laptop": (_laptop, 65, (200, 205, 210), (120, 90, 60)),
    "Car": (_car, 52.6, (170, 200, 235), (90, 90, 95)),
    "Bicycle": (_bicycle, 60, (170, 200, 235), (90, 90, 95)),
}
LABELS = tuple(_THINGS)


def picture(chance: random.Random) -> Picture:
    """Draw one thing on a plain ground, never twice the same."""
    label = chance.choice(LABELS)
    draw, height, behind, below = _THINGS[label]
    wide = chance.uniform(320, 420)
    high = wide * height / 100
    x = chance.uniform(30, SIZE[0] - wide - 30)
    y = chance.uniform(60, SIZE[1] - high - 60)
    image = Image.new("RGB", SIZE, behind)
    ground = y + high * 0.75
    ImageDraw.Draw(image).rectangle((0, ground, *SIZE), fill=below)
    draw(_Pen(image, x, y, wide / 100))
    return Picture(image.filter(ImageFilter.GaussianBlur(0.8)), label, (x, y, wide, high))
