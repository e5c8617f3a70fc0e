"""Experiment `markets`: any of N replicas, with the statistics of real spot traces.

Owns: what is compared. Not here: pools in simulated markets (`simulated`).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from fogft.simulation.model import MarketModel, Timing
from tests.estimates import Estimate, estimate, mean
from tests.evaluation import plotting
from tests.evaluation.experiment import Defaults, Finding, Row, Run, Scale, Stage, Table
from tests.evaluation.samples import Samples
from tests.evaluation.simulated import unavailable
from tests.simulation.arithmetic import staying

REPLICAS = (1, 2, 3, 4)
_MODEL, _TIMING = MarketModel(), Timing()


class Markets(Defaults):
    """See docs/design/evaluation.md."""

    name = "markets"
    title = "Not in the paper: any of N in a scarce spot market"
    claim = (
        "The paper takes preemptions for independent, and does not say what happens where a "
        "region has no room for the replacement."
    )
    method = (
        "The real manager under simulated time in markets with the statistics of public traces of "
        f"AWS V100 machines (room for {_MODEL.mttf_s / 3600:.1f} h, none for "
        f"{_MODEL.mttr_s / 3600:.1f} h, correlation {_MODEL.correlation_region:g} in a region and "
        f"{_MODEL.correlation_cloud:g} between regions). The traces carry no licence: `fogft "
        "simulate --traces` takes them by path, the generator was fitted to them. 'Static' "
        "replicas stay in N zones; fogft's go where there is room. Spot machines only."
    )
    fields = ("replicas", "days", "fogft_down", "static_down")

    def __init__(self) -> None:
        super().__init__(measures=())

    def trials(self, scale: Scale) -> Mapping[str, int]:
        """A trial is a seed."""
        seeds = scale.choose(quick=2, normal=5, full=30)
        return {f"any-of-{n}": seeds for n in REPLICAS}

    @contextlib.contextmanager
    def session(self, stage: Stage) -> Iterator[Run]:
        """Nothing is started: time is simulated."""
        yield lambda condition, seed: _simulate(
            condition, seed, stage.scale.choose(quick=2.0, normal=7.0, full=14.0)
        )

    def findings(self, samples: Samples) -> Sequence[Finding]:
        """Return what independence promises, and what comes."""
        found = []
        for n in REPLICAS[1:]:
            stays = 1 - math.prod([staying(_MODEL, _TIMING)] * n)
            for who, field in (("static", "static_down"), ("fogft", "fogft_down")):
                found.append(
                    Finding(
                        f"Any of {n}, {who}: available",
                        "-",
                        _percent(_up(samples, n, field)),
                        "%",
                        f"Were zones independent, static replicas had {100 * stays:.3g} %."
                        if who == "static"
                        else "Replicas that move meet room elsewhere.",
                    )
                )
        return found

    def tables(self, samples: Samples) -> Sequence[Table]:
        """Return everything by N."""
        rows = []
        for n in REPLICAS:
            independent = 1 - math.prod([staying(_MODEL, _TIMING)] * n)
            static, moving = (_up(samples, n, f) for f in ("static_down", "fogft_down"))
            rows.append([str(n), f"{100 * independent:.4g}", _percent(static), _percent(moving)])
        head = ["replicas", "static, if independent", "static", "fogft"]
        return [Table("Percent of time with an answer", head, rows)]

    def figures(self, samples: Samples) -> Mapping[str, Any]:
        """Draw availability over N."""
        figure, axes = plotting.figure(1, 1)
        axis = axes[0][0]
        one = staying(_MODEL, _TIMING)
        independent = [100 * (1 - math.prod([one] * n)) for n in REPLICAS]
        plotting.curve(axis, REPLICAS, independent, "#222222", "static, if independent")
        for colour, (label, field) in zip(
            plotting.COLOURS, (("static", "static_down"), ("fogft", "fogft_down")), strict=False
        ):
            means = [100 * _up(samples, n, field).value for n in REPLICAS]
            plotting.curve(axis, REPLICAS, means, colour, label)
        axis.set_xticks(REPLICAS)
        axis.set_xlabel("replicas", fontsize=8)
        axis.set_ylabel("% of time with an answer", fontsize=8)
        axis.legend(fontsize=7)
        return {"any-of-n": figure}


def _up(samples: Samples, replicas: int, field: str) -> Estimate:
    up = [1 - down for down in samples.column(f"any-of-{replicas}", field)]
    return estimate(up, mean)


def _percent(found: Estimate) -> str:
    return f"{100 * found.value:.4g} [{100 * found.low:.4g}, {100 * found.high:.4g}]"


def _simulate(condition: str, seed: int, days: float) -> Row:
    replicas = int(condition.rpartition("-")[2])
    down = unavailable(_MODEL, _TIMING, replicas, days, seed)
    return {
        "replicas": replicas,
        "days": days,
        "fogft_down": down["fogft"],
        "static_down": down["static"],
    }


EXPERIMENT = Markets()
