"""Experiment `uplink`: what a robot sends for a request, with a gateway and without.

Owns: the comparison. Not here: counting (`tests.bench.uplink`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from tests.estimates import estimate, mean
from tests.evaluation import plotting
from tests.evaluation.errors import EvaluationError
from tests.evaluation.experiment import Defaults, Finding, Run, Scale, Stage
from tests.evaluation.samples import Samples

REPLICAS = (1, 2, 4)
WAYS = ("directly", "gateway")


class Uplink(Defaults):
    """See docs/design/evaluation.md."""

    name = "uplink"
    title = "Not in the paper: what a robot sends"
    claim = (
        "The paper says that replication costs network bandwidth, and gives no number: N replicas "
        "get N copies of each request from the robot."
    )
    method = (
        "Requests of 100 kB from a client proxy, with and without `fogft gateway`; all bytes of "
        "TCP that leave the robot are counted by a relay, the links' own talk included, as a "
        "multiple of the payload. The processes are fogft's proxies, servers and gateway, without "
        "a manager."
    )
    fields = ("replicas", "requests", "directly", "gateway")

    def __init__(self) -> None:
        super().__init__(measures=WAYS)

    def trials(self, scale: Scale) -> Mapping[str, int]:
        """A trial is a pool that is asked many times."""
        sizes = scale.choose(quick=REPLICAS[1:2], normal=REPLICAS, full=REPLICAS)
        return {f"replicas-{n}": scale.choose(quick=1, normal=1, full=3) for n in sizes}

    @contextlib.contextmanager
    def session(self, stage: Stage) -> Iterator[Run]:
        """Each trial starts its own pool."""
        from tests.bench import uplink

        requests = stage.scale.choose(quick=20, normal=50, full=200)

        def run(condition: str, number: int) -> dict[str, Any]:
            replicas = int(condition.rpartition("-")[2])
            try:
                found = uplink.of_pool(stage.folder / f"{condition}-{number}", replicas, requests)
            except AssertionError as error:  # the pool's own, while it waits
                raise EvaluationError(f"{condition}: {error}; run this again to go on") from None
            return {
                "replicas": replicas,
                "requests": requests,
                "directly": found["directly"],
                "gateway": found["through_a_gateway"],
            }

        yield run

    def findings(self, samples: Samples) -> Sequence[Finding]:
        """Return bytes as multiples of the payload."""
        return [
            Finding(
                f"Bytes from the robot / payload, {condition.replace('-', ' ')}, {way}",
                "-",
                estimate(samples.column(condition, way), mean),
            )
            for condition in samples
            for way in WAYS
        ]

    def figures(self, samples: Samples) -> Mapping[str, Any]:
        """Draw bytes over replicas."""
        figure, axes = plotting.figure(1, 1)
        axis = axes[0][0]
        sizes = [int(condition.rpartition("-")[2]) for condition in samples]
        for colour, way in zip(plotting.COLOURS, WAYS, strict=False):
            means = [mean(samples.column(condition, way)) for condition in samples]
            plotting.curve(axis, sizes, means, colour, way)
        axis.set_xticks(sizes)
        axis.set_ylim(bottom=0)
        axis.set_xlabel("replicas", fontsize=8)
        axis.set_ylabel("bytes sent / payload", fontsize=8)
        axis.legend(fontsize=7)
        return {"bytes": figure}


EXPERIMENT = Uplink()
