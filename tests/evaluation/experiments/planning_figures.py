"""The pictures of `planning`: a column a scene; histograms above, distributions below."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tests.evaluation import plotting
from tests.evaluation.samples import Samples

REPLICAS = (1, 2, 3)
_LABELS = {1: "one server", 2: "2 replicas", 3: "3 replicas"}
_AXES = {"latency_s": "seconds", "checks": "validity checks of the winner"}


def draw(samples: Samples, scenes: Sequence[str]) -> Mapping[str, Any]:
    """Return a figure for seconds and checks, clean and contended."""
    return {
        f"{field.removesuffix('_s')}-{variant}": _one(samples, scenes, variant, field)
        for variant in ("clean", "contended")
        for field in _AXES
    }


def _one(samples: Samples, scenes: Sequence[str], variant: str, field: str) -> Any:
    figure, axes = plotting.figure(len(REPLICAS) + 1, len(scenes))
    for column, scene in enumerate(scenes):
        values = {n: samples.column(f"{scene}-{variant}-{n}", field) for n in REPLICAS}
        bins = plotting.edges(list(values.values()))
        for row, n in enumerate(REPLICAS):
            axis = axes[row][column]
            plotting.histogram(axis, values[n], bins, plotting.COLOURS[row])
            axis.set_title(f"{scene}, {_LABELS[n]}", fontsize=9)
            axis.set_ylabel("trials", fontsize=8)
        below = axes[-1][column]
        for row, n in enumerate(REPLICAS):
            plotting.distribution(below, values[n], plotting.COLOURS[row], _LABELS[n])
        below.set_xlabel(_AXES[field], fontsize=8)
        below.set_ylabel("fraction of trials", fontsize=8)
        below.legend(fontsize=7)
    figure.suptitle(f"Motion planning, {variant}: {_AXES[field]}", fontsize=10)
    return figure
