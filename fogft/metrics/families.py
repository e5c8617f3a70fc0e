"""Metrics as `prometheus-client` has them, made at a scrape of what a process reports.

Nothing is counted through the library: counting on a request's way stays a plain addition. It is
imported at the first scrape, so that a process that nobody scrapes never loads it.
"""

from __future__ import annotations

import math
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING

import fogft

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry, Metric

Labels = Mapping[str, str]
Values = Iterable[tuple[float, Labels]]


def counter(name: str, help: str, values: Values) -> Metric:
    """Return counters of one name, which ends in ``_total``, by their labels."""
    return _family(name.removesuffix("_total"), "counter", help, values, "_total")


def gauge(name: str, help: str, values: Values) -> Metric:
    """Return gauges of one name by their labels; a name ends in its unit."""
    return _family(name, "gauge", help, values)


def histogram(
    name: str,
    help: str,
    bounds: Sequence[float],
    counted: Iterable[tuple[Sequence[int], float, Labels]],
) -> Metric:
    """Return histograms of one name, which ends in its unit.

    Args:
        bounds: Upper bounds of the buckets, rising; one more is without bound.
        counted: How many values fell into each bucket, the last one included; their sum; labels.
    """
    family = _family(name, "histogram", help, ())
    for counts, total, labels in counted:
        known, so_far = _printable(labels), 0
        for bound, count in zip((*bounds, math.inf), counts, strict=True):
            so_far += count
            family.add_sample(f"{name}_bucket", {**known, "le": _bound(bound)}, so_far)
        family.add_sample(f"{name}_count", known, so_far)
        family.add_sample(f"{name}_sum", known, total)
    return family


def _bound(bound: float) -> str:
    return "+Inf" if bound == math.inf else str(float(bound))


def _family(name: str, kind: str, help: str, values: Values, suffix: str = "") -> Metric:
    from prometheus_client import Metric

    family = Metric(name, help, kind)
    for value, labels in values:
        family.add_sample(f"{name}{suffix}", _printable(labels), float(value))
    return family


def _printable(labels: Labels) -> dict[str, str]:
    """Return labels that can be sent: a lone surrogate cannot."""
    return {key: value.encode(errors="replace").decode() for key, value in labels.items()}


class _Collector:
    """What one process tells: its families as measured now, each with the process's labels."""

    def __init__(self, measure: Callable[[], Iterable[Metric]], labels: Labels) -> None:
        self._measure = measure
        self._labels = dict(labels)

    def collect(self) -> Iterator[Metric]:
        """Yield what there is to tell; families without samples are left out."""
        yield gauge(
            "fogft_build_info",
            "Version of fogft and of Python.",
            [(1, {"version": fogft.__version__, "python": platform.python_version()})],
        )
        from prometheus_client import ProcessCollector

        for family in chain(self._measure(), ProcessCollector(registry=None).collect()):
            family.samples = [
                sample._replace(labels={**self._labels, **sample.labels})
                for sample in family.samples
            ]
            if family.samples:
                yield family


def registry(measure: Callable[[], Iterable[Metric]], labels: Labels) -> CollectorRegistry:
    """Return the registry of a process: what is measured at each look, with these labels."""
    from prometheus_client import CollectorRegistry

    made = CollectorRegistry(auto_describe=False)
    made.register(_Collector(measure, labels))
    return made
