"""Draw a plan: each offer's price against its distance, the chosen ones filled. SVG, by hand.

Owns: the drawing.
Not here: what is drawn (`fogft.planning.explain`).
"""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from fogft.errors import FogftError

if TYPE_CHECKING:
    from fogft.pool.commands.plan import PlanShown

_WIDTH, _HEIGHT, _EDGE = 720, 480, 64
_COLOURS = ("#1b6ca8", "#c1440e", "#3a7d44", "#7b4f9d", "#8a6d00")
_UNKNOWN_MS = 0.0


def write(file: Path, shown: PlanShown) -> None:
    """Write the drawing.

    Raises:
        FogftError: The file cannot be written.
    """
    try:
        file.write_text(drawing(shown), encoding="utf-8")
    except OSError as error:
        raise FogftError(f"`{file}` cannot be written: {error.strerror}") from error


def drawing(shown: PlanShown) -> str:
    """Return the drawing as SVG. Offers of unknown distance stand at the left edge."""
    considered = shown.explanation.considered
    points = [
        ((one.rtt_s or 0.0) * 1000 if one.rtt_s else _UNKNOWN_MS, one.offer.usd_per_hour, one)
        for one in considered
    ]
    far = max([x for x, _, _ in points] + [1.0]) * 1.05
    dear = max([y for _, y, _ in points] + [0.001]) * 1.05
    clouds = sorted({one.offer.placement.cloud for one in considered})
    body = [_axes(far, dear, shown.spec.name)]
    for x, y, one in points:
        place = one.offer.placement
        colour = _COLOURS[clouds.index(place.cloud) % len(_COLOURS)]
        fill = colour if one.slots else "none"
        told = f"{place.location} {place.instance} ${y:.3f}/h {x:.0f} ms {one.why_not}"
        body.append(
            f'<circle cx="{_x(x, far):.1f}" cy="{_y(y, dear):.1f}" r="{7 if one.slots else 4}" '
            f'fill="{fill}" stroke="{colour}"><title>{escape(told)}</title></circle>'
        )
        if one.slots:
            name = f"slot {','.join(map(str, one.slots))}"
            body.append(_text(_x(x, far) + 10, _y(y, dear) + 4, name))
    for index, cloud in enumerate(clouds):
        colour = _COLOURS[index % len(_COLOURS)]
        body.append(_text(_WIDTH - _EDGE - 60, _EDGE + 16 * index, cloud, colour))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" '
        f'font-family="sans-serif" font-size="12">\n' + "\n".join(body) + "\n</svg>\n"
    )


def _axes(far: float, dear: float, pool: str) -> str:
    left, right, top, bottom = _EDGE, _WIDTH - _EDGE, _EDGE, _HEIGHT - _EDGE
    parts = [
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="white"/>',
        f'<path d="M{left} {top}V{bottom}H{right}" fill="none" stroke="#444"/>',
        _text(left, top - 24, f"{pool}: offers considered, chosen ones filled"),
        _text(right - 150, bottom + 36, "round trip in milliseconds"),
        _text(8, top - 8, "US dollars per hour"),
    ]
    for step in range(5):
        x, y = far * step / 4, dear * step / 4
        parts.append(_text(_x(x, far) - 8, bottom + 16, f"{x:.0f}"))
        parts.append(_text(16, _y(y, dear) + 4, f"{y:.2f}"))
    return "\n".join(parts)


def _x(value: float, limit: float) -> float:
    return _EDGE + value / limit * (_WIDTH - 2 * _EDGE)


def _y(value: float, limit: float) -> float:
    return _HEIGHT - _EDGE - value / limit * (_HEIGHT - 2 * _EDGE)


def _text(x: float, y: float, text: str, colour: str = "#222") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}">{escape(text)}</text>'
