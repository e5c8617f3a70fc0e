"""Experiment `failures`: the paper's failure qualification (III.C), put right and simulated.

Owns: what is compared. Not here: the arithmetic (`fogft.planning.availability`), pools in
simulated markets (`simulated`), the number of replicas for a target (`fogft plan`).
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from fogft.planning.availability import replicas_needed, unavailability
from fogft.simulation.model import MarketModel, Timing
from tests.estimates import Estimate, estimate, mean
from tests.evaluation import plotting
from tests.evaluation.experiment import Defaults, Finding, Row, Run, Scale, Stage, Table
from tests.evaluation.pools import Pools
from tests.evaluation.samples import Samples
from tests.evaluation.simulated import unavailable

UPTIME_S, RECOVERY_S = 15 * 3600.0, 20 * 60.0  # the paper's
TARGETS = (0.999, 0.9995, 0.9999, 0.99999)
CORRELATIONS = {"independent": 0.0, "correlated": 0.22}
REPLICAS = (1, 2, 3)
# Recovery is the boot: no notice, a loss seen at once. A zone without room has none for 2 h.
_TIMING = Timing(boot_s=RECOVERY_S, notice_s=0.0, answer_s=0.0, detect_s=0.0)
_MARKET = MarketModel(mttf_s=UPTIME_S, mttr_s=7200.0, together=0.0)


def printed(one: float, system: float) -> int:
    """Return N by the fraction as the paper prints it."""
    return math.ceil(math.log(one) / math.log(system))


def corrected(one: float, system: float) -> int:
    """Return N by the fraction the right way up."""
    return math.ceil(math.log(system) / math.log(one))


class Failures(Defaults):
    """See docs/design/evaluation.md."""

    name = "failures"
    title = "Failure qualification: how many spot machines"
    claim = (
        "A spot VM is preempted every 15 h and takes 20 min to come back, so P_VM = 2.17 %; the "
        "probability that two are away together is less than 0.05 %, which is the promise of AWS "
        "for on-demand VMs. N = ceil(log P_VM / log P_system)."
    )
    method = (
        "The formula with the paper's numbers; what `fogft plan` wants for a target; and the real "
        "manager under simulated time in markets with the paper's uptime and recovery, with zones "
        "that fail independently and with the correlation of 0.22 that public spot traces show "
        "between zones. 'Static' replicas wait for room where they are; fogft's go elsewhere."
    )
    fields = ("replicas", "correlation", "days", "fogft_down", "static_down", "target", "wanted")

    def __init__(self) -> None:
        super().__init__(measures=())

    def trials(self, scale: Scale) -> Mapping[str, int]:
        """A trial is a seed; of `planned`, a target."""
        seeds = scale.choose(quick=2, normal=8, full=30)
        out = {f"{name}-{n}": seeds for name in CORRELATIONS for n in REPLICAS}
        return {"planned": len(TARGETS), **out}

    @contextlib.contextmanager
    def session(self, stage: Stage) -> Iterator[Run]:
        """Nothing is started: time is simulated."""
        days = stage.scale.choose(quick=5.0, normal=20.0, full=60.0)
        with stage.pools() as pools:
            yield (
                lambda condition, number: (
                    _plan(pools, TARGETS[number])
                    if condition == "planned"
                    else _simulate(condition, number, days)
                )
            )

    def findings(self, samples: Samples) -> Sequence[Finding]:
        """Return the paper's numbers, by formula and by simulation."""
        one = unavailability(UPTIME_S, RECOVERY_S)
        two = math.prod([one, one])
        alone, pair = (_down(samples, f"independent-{n}") for n in (1, 2))
        fate = _down(samples, "correlated-2")
        planned = {float(row["target"]): int(row["wanted"]) for row in samples["planned"]}
        return [
            Finding("One VM away: formula", "2.17", f"{100 * one:.3g}", "%"),
            Finding(
                "One VM away: simulated, independent zones", "2.17", _percent(alone), "%",
                _agrees(alone, one),
            ),
            Finding("Two VMs away together: formula", "< 0.05", f"{100 * two:.3g}", "%"),
            Finding(
                "Two VMs away together: simulated, independent zones", "< 0.05", _percent(pair),
                "%", _agrees(pair, two),
            ),
            Finding(
                "Two VMs away together: simulated, correlation 0.22", "< 0.05", _percent(fate), "%",
                "Zones that lose room together break the formula's assumption: as simulated, both "
                f"are away {fate.value / two:.2g} times as often as it says.",
            ),
            Finding(
                "N for 99.95 %, by the fraction as printed", "2", str(printed(one, 1 - 0.9995)), "",
                "The paper prints log P_VM / log P_system; its own example needs log P_system / "
                "log P_VM.",
            ),
            Finding("N for 99.95 %, fraction the right way up", "2",
                    str(corrected(one, 1 - 0.9995)), ""),
            Finding(
                "N for 99.95 % as `fogft plan` has it, correlation 0.22 assumed in a region", "2",
                str(planned[0.9995]), "",
                "" if planned[0.9995] == 2 else
                "fogft counts on correlation between zones and regions unless told otherwise.",
            ),
        ]  # fmt: skip

    def tables(self, samples: Samples) -> Sequence[Table]:
        """Return N for each target, and what was simulated."""
        one = unavailability(UPTIME_S, RECOVERY_S)
        needed = [
            [
                f"{100 * float(row['target']):g} %",
                str(printed(one, 1 - float(row["target"]))),
                str(corrected(one, 1 - float(row["target"]))),
                str(replicas_needed(1 - one, float(row["target"]))),
                str(row["wanted"]),
            ]
            for row in samples["planned"]
        ]
        simulated = [
            [
                name,
                str(n),
                f"{100 * one**n:.3g} %",
                f"{_percent(_down(samples, f'{name}-{n}'))} %",
                f"{_percent(_down(samples, f'{name}-{n}', 'static_down'))} %",
            ]
            for name in CORRELATIONS
            for n in REPLICAS
        ]
        return [
            Table(
                "Replicas for a target",
                ["target", "N as printed", "N corrected", "fogft, independent",
                 "`fogft plan`, correlated"],
                needed,
            ),
            Table(
                "Time without any answer",
                ["zones", "replicas", "formula", "simulated, fogft", "simulated, static"],
                simulated,
            ),
        ]  # fmt: skip

    def figures(self, samples: Samples) -> Mapping[str, Any]:
        """Draw unavailability over replicas. What was never down is not on a log scale."""
        figure, axes = plotting.figure(1, 1)
        one, axis = unavailability(UPTIME_S, RECOVERY_S), axes[0][0]
        plotting.curve(axis, REPLICAS, [one**n for n in REPLICAS], "#222222", "formula")
        for colour, name in zip(plotting.COLOURS, CORRELATIONS, strict=False):
            means = [_down(samples, f"{name}-{n}").value for n in REPLICAS]
            plotting.curve(axis, REPLICAS, means, colour, f"simulated, {name}")
        axis.set_yscale("log", nonpositive="mask")
        axis.set_xticks(REPLICAS)
        axis.set_xlabel("replicas", fontsize=8)
        axis.set_ylabel("share of time unanswered", fontsize=8)
        axis.legend(fontsize=7)
        return {"unavailability": figure}


def _down(samples: Samples, condition: str, field: str = "fogft_down") -> Estimate:
    return estimate(samples.column(condition, field), mean)


def _percent(found: Estimate) -> str:
    return f"{100 * found.value:.3g} [{100 * found.low:.3g}, {100 * found.high:.3g}]"


def _agrees(found: Estimate, formula: float) -> str:
    if found.low <= formula <= found.high:
        return "The formula lies within the simulation's interval."
    return (
        "A simulated machine may be lost again while it boots, and a few outages of some minutes "
        "make up the figure: more days (--full) narrow it."
    )


def _simulate(condition: str, seed: int, days: float) -> Row:
    name, _, replicas = condition.rpartition("-")
    correlation = CORRELATIONS[name]
    model = replace(_MARKET, correlation_region=correlation, correlation_cloud=correlation)
    down = unavailable(model, _TIMING, int(replicas), days, seed)
    return {
        "replicas": int(replicas),
        "correlation": correlation,
        "days": days,
        "fogft_down": down["fogft"],
        "static_down": down["static"],
        "target": "",
        "wanted": "",
    }


def _plan(pools: Pools, target: float) -> Row:
    file = pools.folder / "pool.yaml"
    file.write_text(
        "run: exec true\nresources: {use_spot: true}\nfogft:\n"
        "  services: [{name: /plan, type: nav_msgs/srv/GetPlan}]\n"
        f"  availability: {{target: {target}, spot_uptime_s: {UPTIME_S}, "
        f"recovery_s: {RECOVERY_S}}}\n"
    )
    shown = json.loads(pools.fogft("plan", str(file), "--offline", "--json"))
    return {
        "replicas": "", "correlation": "", "days": "", "fogft_down": "", "static_down": "",
        "target": target, "wanted": shown["wanted"],
    }  # fmt: skip


EXPERIMENT = Failures()
