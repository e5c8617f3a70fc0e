"""Metrics in Prometheus's text format, version 0.0.4. Pure.

Owns: the text. Not here: what is measured, and serving it (`fogft.metrics.scrape`).

Source: Prometheus, "Exposition formats".
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
COUNTER, GAUGE, HISTOGRAM = "counter", "gauge", "histogram"


@dataclass(frozen=True)
class Sample:
    """One value of a family. `suffix` is that of a histogram's parts."""

    value: float
    labels: Mapping[str, str] = field(default_factory=dict)
    suffix: str = ""


@dataclass(frozen=True)
class Family:
    """A metric: a name, what it is, and its values.

    A name ends in its unit, a counter's in `_total`.
    """

    name: str
    kind: str
    help: str
    samples: tuple[Sample, ...]


def of(name: str, kind: str, help: str, samples: Iterable[Sample]) -> Family:
    """Return a family of some samples."""
    return Family(name, kind, help, tuple(samples))


def histogram(
    bounds: Sequence[float], counts: Sequence[int], total: float, labels: Mapping[str, str]
) -> tuple[Sample, ...]:
    """Return a histogram's samples.

    Args:
        bounds: Upper bounds of the buckets, rising; one more is without bound.
        counts: How many values fell into each bucket, the last one included.
        total: The sum of all values.
        labels: What tells it from others of its family.
    """
    found, so_far = [], 0
    for bound, count in zip((*bounds, math.inf), counts, strict=True):
        so_far += count
        found.append(Sample(so_far, {**labels, "le": _number(bound)}, "_bucket"))
    return (*found, Sample(total, labels, "_sum"), Sample(so_far, labels, "_count"))


def text(families: Iterable[Family]) -> str:
    """Return families as Prometheus reads them; those without samples are left out."""
    lines: list[str] = []
    for family in families:
        if not family.samples:
            continue
        help = family.help.replace("\\", r"\\").replace("\n", r"\n")
        lines += [f"# HELP {family.name} {help}", f"# TYPE {family.name} {family.kind}"]
        lines += [_line(family.name, sample) for sample in family.samples]
    return "".join(line + "\n" for line in lines)


def _line(name: str, sample: Sample) -> str:
    labels = ",".join(f'{key}="{_escaped(value)}"' for key, value in sample.labels.items())
    return f"{name}{sample.suffix}{'{' + labels + '}' if labels else ''} {_number(sample.value)}"


def _escaped(value: str) -> str:
    plain = value.encode(errors="replace").decode()  # a lone surrogate cannot be sent
    return plain.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


def _number(value: float) -> str:
    if math.isinf(value):
        return "+Inf" if value > 0 else "-Inf"
    if math.isnan(value):
        return "NaN"
    return (
        str(int(value)) if float(value).is_integer() and abs(value) < 1e15 else repr(float(value))
    )
