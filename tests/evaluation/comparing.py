"""What detection and segmentation share: one server and two replicas, with a fault and without.

Owns: the conditions' names, their pools, the ratios and pictures. Not here: what the fault is.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.estimates import Estimate, mean, p99, ratio
from tests.evaluation import plotting
from tests.evaluation.errors import EvaluationError
from tests.evaluation.experiment import Finding, Table
from tests.evaluation.pools import Pools
from tests.evaluation.samples import Samples

CONDITIONS = ("single", "two", "single-fault", "two-fault")
REGIONS = ("us-west-1", "us-west-2")  # the paper's California and Oregon
LABELS = {
    "single": "one server",
    "two": "two replicas",
    "single-fault": "one server (F)",
    "two-fault": "two replicas (F)",
}


def faulted(condition: str) -> bool:
    """Return whether a condition has the fault."""
    return condition.endswith("-fault")


def replicas(condition: str) -> int:
    """Return how many replicas its pool has."""
    return 2 if condition.startswith("two") else 1


def pool_file(pools: Pools, name: str, count: int, workspace: Path, run: str, service: str) -> Path:
    """Write a pool of one or two replicas that run an example in its workspace.

    Args:
        pools: Where it goes.
        name: Of the pool.
        count: 1 in us-west-1, 2 with one in us-west-2 beside it.
        workspace: The example, built.
        run: Its command.
        service: An entry of `services`, as one line of YAML.
    """
    any_of = ", ".join(f"{{infra: local/{region}}}" for region in REGIONS[:count])
    file = pools.folder / f"{name}.yaml"
    file.write_text(
        f"name: {name}\n"
        f"resources: {{use_spot: {str(count > 1).lower()}, any_of: [{any_of}]}}\n"
        f"workdir: {shlex.quote(str(workspace))}\n"
        f"run: exec {run}\n"
        "fogft:\n"
        f"  services: [{service}]\n"
        f"  replicas: {count}\n"
    )
    return file


def replica_in(pools: Pools, pool: str, region: str) -> dict[str, Any]:
    """Return what the status says of a pool's replica in a region."""
    found = [r for r in pools.ready(pool) if region in r["location"]]
    if len(found) != 1:
        raise EvaluationError(f"{pool} has {len(found)} ready replicas in {region}, not one")
    return found[0]


def findings(
    samples: Samples, paper: Mapping[str, tuple[str, str]], whys: Mapping[str, str]
) -> list[Finding]:
    """Return single over two for the mean and the P99, with the fault and without.

    Args:
        samples: Of the four conditions.
        paper: For ``""`` and ``-fault``: the paper's ratios of mean and P99.
        whys: What may stand behind a difference: `less` and `more`, each of ``mean`` and
            ``P99``, as ``P99 less``, and the same without a fault, as ``P99 less healthy``.
    """
    found = []
    for kind, (mean_of_paper, p99_of_paper) in paper.items():
        one, two = (samples.column(f"{n}{kind}", "latency_s") for n in ("single", "two"))
        fault = "with the fault" if kind else "without a fault"
        for word, statistic, theirs in (("mean", mean, mean_of_paper), ("P99", p99, p99_of_paper)):
            ours = ratio(one, two, statistic)
            why = _why(theirs, ours, word if kind else f"{word} healthy", whys)
            what = f"{fault}, {word}: one server / two replicas"
            found.append(Finding(what, theirs, ours, why=why))
    return found


def _why(paper: str, ours: Estimate, word: str, whys: Mapping[str, str]) -> str:
    try:
        theirs = float(paper)
    except ValueError:
        return whys[word]
    if ours.low <= theirs <= ours.high:
        return "The paper's figure lies within our interval."
    return whys[f"{word} {'less' if ours.high < theirs else 'more'}"]


def requests(samples: Samples) -> Table:
    """Return how many requests there were, and how many failed or were answered wrongly."""
    rows = [
        [LABELS[c], str(len(rows)), str(sum(not r["ok"] for r in rows))]
        for c, rows in samples.items()
    ]
    return Table("Requests", ["condition", "asked", "no answer, or a wrong one"], rows)


def figure(samples: Samples, title: str) -> Any:
    """Draw a histogram for each condition, and all distributions in one."""
    made, axes = plotting.figure(2, 3)
    values = {c: samples.column(c, "latency_s") for c in samples}
    bins = plotting.edges(list(values.values()))
    places = (axes[0][0], axes[0][1], axes[1][0], axes[1][1])
    for axis, colour, condition in zip(places, plotting.COLOURS, values, strict=False):
        plotting.histogram(axis, values[condition], bins, colour)
        axis.set_title(LABELS[condition], fontsize=9)
        axis.set_xlabel("latency, s", fontsize=8)
        axis.set_ylabel("requests", fontsize=8)
    for axis, kind in ((axes[0][2], ""), (axes[1][2], "-fault")):
        for colour, condition in zip(plotting.COLOURS, values, strict=False):
            if condition.endswith("-fault") == bool(kind):
                plotting.distribution(axis, values[condition], colour, LABELS[condition])
        axis.set_xlabel("latency, s", fontsize=8)
        axis.set_ylabel("fraction of requests", fontsize=8)
        axis.legend(fontsize=7)
    made.suptitle(title, fontsize=10)
    return made


def medians(samples: Samples, field: str, conditions: Sequence[str]) -> dict[str, float]:
    """Return the median of a column for some conditions."""
    from tests.estimates import median

    return {c: median(samples.column(c, field)) for c in conditions}
