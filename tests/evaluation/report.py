"""The report: one HTML file that needs no other, and the plots beside it as PNG and SVG.

Owns: what is said of every experiment alike. Not here: words and pictures of one experiment.
"""

from __future__ import annotations

import base64
import html
import io
import json
import re
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tests import estimates
from tests.evaluation.experiment import Experiment, Finding, Table
from tests.evaluation.samples import Samples

_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;color:#222}
table{border-collapse:collapse;margin:1rem 0;font-size:.9em}
th,td{border-bottom:1px solid #ccc;padding:.3em .7em;text-align:left;vertical-align:top}
td.n{font-variant-numeric:tabular-nums;white-space:nowrap}
img{max-width:100%}h2{margin-top:3rem;border-top:2px solid #222;padding-top:.5rem}
.why{max-width:30rem}caption{text-align:left;font-weight:600}
"""
_SVG: Any = {"svg.hashsalt": "fogft", "svg.fonttype": "none"}  # the same samples, the same file


def write(
    into: Path, experiments: Mapping[str, Experiment], samples: Mapping[str, Samples]
) -> Path:
    """Draw all figures and write ``report.html``; return its path."""
    settings = json.loads((into / "machine.json").read_text())
    parts = [page_head(settings)]
    for name, experiment in experiments.items():
        parts += section(into, experiment, samples[name])
    target = into / "report.html"
    target.write_text("\n".join([*parts, "</body></html>", ""]))
    return target


def page_head(machine: Mapping[str, Any]) -> str:
    """Return the page's beginning: where this was run, and how to read it."""
    described = (
        f"{machine['processor']}, {machine['cores']} cores, "
        f"{machine['memory_bytes'] / 2**30:.0f} GiB, {machine['system']}, "
        f"Linux {machine['kernel']}, Python {machine['python']}"
    )
    return (
        "<!doctype html><html lang=en><head><meta charset=utf-8>"
        f"<title>FogROS2-FT's evaluation, reproduced with fogft</title><style>{_STYLE}</style>"
        "</head><body><h1>FogROS2-FT's evaluation, reproduced with fogft</h1>"
        f"<p>Run with <code>scripts/reproduce</code> on one machine: {html.escape(described)}.</p>"
        "<p>Replicas are processes of the local cloud in named regions, below real proxies and "
        "real ROS 2 nodes. In brackets: 95 % bootstrap intervals. <i>x</i> is the baseline's "
        "figure over that of the replicas: above 1, replicas are faster. Trials of all "
        "conditions of an experiment take turns, so that other load on the machine meets them "
        "alike; times compare within this run only.</p>"
    )


def section(into: Path, experiment: Experiment, samples: Samples) -> Iterator[str]:
    """Yield one experiment's part of the page; write its plots."""
    yield f"<h2 id={experiment.name}>{_said(experiment.title)}</h2>"
    yield f"<p><b>The paper.</b> {_said(experiment.claim)}</p>"
    yield f"<p><b>Here.</b> {_said(experiment.method)}</p>"
    yield f"<p>{circumstances(samples)}</p>"
    findings = experiment.findings(samples)
    if findings:
        yield from findings_table(findings)
    try:
        figures = experiment.figures(samples)
    except ImportError:  # what draws them is not installed for another experiment's run
        yield from drawn_before(into / experiment.name)
    else:
        for name, figure in figures.items():
            yield picture(into / experiment.name, name, figure)
    if experiment.measures:
        yield from table(measured(experiment, samples))
    for one in experiment.tables(samples):
        yield from table(one)
    files = " ".join(
        f"<a href='{experiment.name}/{c}.csv'>{c}</a> ({len(samples[c])})" for c in samples
    )
    yield f"<p>Raw samples: {files}</p>"


def _said(text: str) -> str:
    """Return text as HTML; what stands in backticks is code."""
    return re.sub("`([^`]+)`", r"<code>\1</code>", html.escape(text))


def circumstances(samples: Samples) -> str:
    """Say when an experiment was run, and beside how much other work."""
    rows = [row for condition in samples for row in samples[condition]]
    first, last = (pick(float(row["began_at"]) for row in rows) for pick in (min, max))
    loads = [float(row["load"]) for row in rows]
    return (
        f"{len(rows)} trials, begun between {_moment(first)} and {_moment(last)}; load average "
        f"{min(loads):.1f} to {max(loads):.1f}, median {estimates.median(loads):.1f}."
    )


def _moment(seconds: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(seconds))


def findings_table(findings: Any) -> Iterator[str]:
    """Yield the comparison with the paper."""
    yield "<table><tr><th>figure<th>paper<th>ours<th>why they differ</tr>"
    for one in findings:
        yield (
            f"<tr><td>{html.escape(one.what)}<td class=n>{_with_unit(one.paper, one.unit)}"
            f"<td class=n>{_with_unit(str(one.ours), one.unit)}"
            f"<td class=why>{_said(one.why)}</tr>"
        )
    yield "</table>"


def _with_unit(text: str, unit: str) -> str:
    return html.escape(text if text == "-" or not unit else f"{text} {unit}")


def measured(experiment: Experiment, samples: Samples) -> Table:
    """Return the table of an experiment's measures, a row for each condition."""
    rows = []
    for condition in samples:
        for measure in experiment.measures:
            values = samples.column(condition, measure)
            if values:
                numbers = (
                    estimates.mean(values),
                    estimates.median(values),
                    estimates.p99(values),
                    max(values),
                )
                rows.append([condition, measure, str(len(values)), *(f"{n:.4g}" for n in numbers)])
    return Table("", ["condition", "measure", "n", "mean", "p50", "p99", "max"], rows)


def table(one: Table) -> Iterator[str]:
    """Yield a table as it is."""
    yield f"<table><caption>{html.escape(one.title)}</caption>"
    yield "<tr>" + "".join(f"<th>{html.escape(cell)}" for cell in one.head) + "</tr>"
    for row in one.rows:
        yield "<tr>" + "".join(f"<td class=n>{html.escape(cell)}" for cell in row) + "</tr>"
    yield "</table>"


def picture(folder: Path, name: str, figure: Any) -> str:
    """Write a figure as PNG and SVG; return it as part of the page."""
    import matplotlib

    folder.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context(_SVG):
        figure.savefig(folder / f"{name}.png", dpi=80)
        svg = io.BytesIO()
        figure.savefig(svg, format="svg", metadata={"Date": None})
    # Coordinates are points, 1/72 inch: two digits are plenty, and make half the file.
    small = re.sub(rb"(\d+\.\d\d)\d+", rb"\1", svg.getvalue())
    (folder / f"{name}.svg").write_bytes(small)
    return shown(folder, name)


def drawn_before(folder: Path) -> Iterator[str]:
    """Yield the pictures that an earlier run left, as parts of the page."""
    for path in sorted(folder.glob("*.svg")):
        yield shown(folder, path.stem)


def shown(folder: Path, name: str) -> str:
    """Return a picture as part of the page: the smaller of its two files."""
    files = {"svg+xml": folder / f"{name}.svg", "png": folder / f"{name}.png"}
    kind = min(files, key=lambda kind: files[kind].stat().st_size)
    data = base64.b64encode(files[kind].read_bytes()).decode()
    return f"<p><img alt='{html.escape(name)}' src='data:image/{kind};base64,{data}'></p>"


__all__ = ["Finding", "measured", "page_head", "section", "write"]
