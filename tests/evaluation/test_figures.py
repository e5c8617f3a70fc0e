"""What a plot shows is what the CSV files hold: lines and bars are read back and compared."""

from __future__ import annotations

import csv
import random

import pytest

from tests.bench.rig import ROOT
from tests.evaluation import plotting, registry, report, running
from tests.evaluation.experiments import (
    costs,
    failures,
    markets,
    overhead,
    planning,
    recovery,
    uplink,
)
from tests.evaluation.samples import Store
from tests.needs import need

need("matplotlib")


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "results"


def fill(folder, experiment, conditions, row):
    """Write rows as a run does; return the experiment's samples, read again from the files."""
    store = Store(folder, experiment.fields)
    for condition, count in conditions.items():
        for trial in range(count):
            common = {"trial": trial, "began_at": 0.0, "load": 0.0}
            store.append(condition, {**common, **row(condition, trial)})
    return store.samples(list(conditions))


def column(folder, condition, field):
    """Read a column with nothing of ours."""
    with (folder / f"{condition}.csv").open() as file:
        return [float(row[field]) for row in csv.DictReader(file)]


def drawn(figure):
    """Draw a figure; return its canvas."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return canvas


@pytest.mark.parametrize("draw", [plotting.distribution, plotting.series, plotting.curve])
def test_what_colours_tell_apart_is_told_apart_without_them(draw):
    seen = set()
    for colour in plotting.COLOURS:
        figure, axes = plotting.figure(1, 1)
        values = [1.0, 2.0, 4.0]
        draw(axes[0][0], values, *([] if draw is plotting.distribution else [values]), colour, "")
        for line in axes[0][0].lines:
            line.set_color("black")
        seen.add(bytes(drawn(figure).buffer_rgba()))
    assert len(seen) == len(plotting.COLOURS)


@pytest.mark.parametrize("name", ["costs", "failures", "markets", "overhead", "recovery", "uplink"])
def test_every_label_is_whole(name):
    """None sticks out of the pictures that docs/results has."""
    experiment = registry.load(name)
    folder = ROOT / "docs" / "results"
    found = running.found(folder, {name: experiment})
    for figure in experiment.figures(found[name]).values():
        drawn(figure)
        width, height = figure.bbox.size
        for axis in figure.axes:
            for text in (axis.xaxis.label, axis.yaxis.label, axis.title):
                box = text.get_window_extent()
                if text.get_text():
                    assert -1 <= box.x0 <= box.x1 <= width + 1, text
                    assert -1 <= box.y0 <= box.y1 <= height + 1, text


def steps(axis):
    """Return what an axis' lines show: label -> x, y."""
    return {
        line.get_label(): (list(line.get_xdata()), list(line.get_ydata())) for line in axis.lines
    }


def is_distribution_of(shown, values):
    x, y = shown
    assert x == sorted(values)
    assert y == pytest.approx([(i + 1) / len(values) for i in range(len(values))])


def test_planning(folder):
    """Each histogram counts the file's values in its bins; each distribution has them all."""
    source = random.Random(1)

    def row(condition, trial):
        return {
            "ok": 1, "latency_s": source.expovariate(2.0), "checks": source.randrange(1, 9999),
            "search_s": 0.1, "winner": 0, "contended": 0, "stolen_s": 0.0, "fault": "",
        }  # fmt: skip

    conditions = {
        f"{scene}-{how}-{n}": 40
        for scene in ("cubicles", "twist")
        for how in ("clean", "contended")
        for n in planning.REPLICAS
    }
    samples = fill(folder, planning.EXPERIMENT, conditions, row)
    figures = planning.EXPERIMENT.figures(samples)
    assert set(figures) == {
        "latency-clean", "latency-contended", "checks-clean", "checks-contended"
    }  # fmt: skip
    for name, figure in figures.items():
        field, how = name.split("-")
        field = {"latency": "latency_s"}.get(field, field)
        axes = figure.axes
        for place, scene in enumerate(("cubicles", "twist")):
            below = steps(axes[3 * 2 + place])
            for number, n in enumerate(planning.REPLICAS):
                values = column(folder, f"{scene}-{how}-{n}", field)
                is_distribution_of(
                    below[("one server", "2 replicas", "3 replicas")[number]], values
                )
                bars = axes[number * 2 + place].patches
                assert sum(bar.get_height() for bar in bars) == len(values)
                for bar in bars[:-1]:  # the last bin holds its upper edge, too
                    low, high = bar.get_x(), bar.get_x() + bar.get_width()
                    assert bar.get_height() == pytest.approx(
                        sum(low <= v < high for v in values), abs=1
                    )


def test_costs(folder):
    """A bar for each cell of the table, as long as its cost."""

    def row(condition, trial):
        application = costs.PAPER[trial]
        return {
            "application": application.name, "asks": application.asks,
            "paper_usd": application.usd_per_hour[0], "ours_usd": 0.1 + trial, "machines": "",
            "regions": "",
        }  # fmt: skip

    samples = fill(folder, costs.EXPERIMENT, dict.fromkeys(costs.COLUMNS, 6), row)
    figure = costs.EXPERIMENT.figures(samples)["costs"]
    for axis, condition in zip(figure.axes, costs.COLUMNS, strict=True):
        lengths = [bar.get_width() for bar in axis.patches]
        assert lengths[:6] == column(folder, condition, "paper_usd")
        assert lengths[6:] == column(folder, condition, "ours_usd")


def test_failures(folder):
    """The means of the files, beside the formula."""
    source = random.Random(2)

    def row(condition, trial):
        return {
            "replicas": 1, "correlation": 0.0, "days": 1.0, "fogft_down": source.random() / 9,
            "static_down": 0.5, "target": 0.99, "wanted": 2,
        }  # fmt: skip

    conditions = {f"{name}-{n}": 5 for name in failures.CORRELATIONS for n in failures.REPLICAS}
    samples = fill(folder, failures.EXPERIMENT, {"planned": 4, **conditions}, row)
    shown = steps(failures.EXPERIMENT.figures(samples)["unavailability"].axes[0])
    assert shown["formula"][1] == pytest.approx([0.0217391, 0.0217391**2, 0.0217391**3], rel=1e-4)
    for name in failures.CORRELATIONS:
        means = [sum(column(folder, f"{name}-{n}", "fogft_down")) / 5 for n in failures.REPLICAS]
        assert shown[f"simulated, {name}"] == ([1, 2, 3], pytest.approx(means))


def test_markets(folder):
    source = random.Random(3)

    def row(condition, trial):
        return {
            "replicas": 1, "days": 1.0, "fogft_down": source.random(),
            "static_down": source.random(),
        }  # fmt: skip

    conditions = {f"any-of-{n}": 4 for n in markets.REPLICAS}
    samples = fill(folder, markets.EXPERIMENT, conditions, row)
    shown = steps(markets.EXPERIMENT.figures(samples)["any-of-n"].axes[0])
    for label, field in (("static", "static_down"), ("fogft", "fogft_down")):
        up = [100 - 25 * sum(column(folder, condition, field)) for condition in conditions]
        assert shown[label] == ([1, 2, 3, 4], pytest.approx(up))


def test_overhead(folder):
    source = random.Random(4)
    conditions = {"direct": 30, "replicas-1": 30, "replicas-2": 30, "replicas-3": 30}
    samples = fill(
        folder,
        overhead.EXPERIMENT,
        conditions,
        lambda *_: {"ok": 1, "latency_s": source.random()},
    )
    shown = steps(overhead.EXPERIMENT.figures(samples)["latency"].axes[0])
    for condition in conditions:
        values = [1000 * v for v in column(folder, condition, "latency_s")]
        is_distribution_of(shown[condition.replace("-", " ")], values)


def test_uplink(folder):
    source = random.Random(5)

    def row(condition, trial):
        return {
            "replicas": 1, "requests": 9, "directly": source.random(), "gateway": source.random()
        }  # fmt: skip

    conditions = {"replicas-1": 3, "replicas-2": 3, "replicas-4": 3}
    samples = fill(folder, uplink.EXPERIMENT, conditions, row)
    shown = steps(uplink.EXPERIMENT.figures(samples)["bytes"].axes[0])
    for way in uplink.WAYS:
        means = [sum(column(folder, condition, way)) / 3 for condition in conditions]
        assert shown[way] == ([1, 2, 4], pytest.approx(means))


def test_recovery(folder):
    source = random.Random(6)

    def row(condition, trial):
        moments = {field: source.random() for field in recovery.MOMENTS}
        return {"fault": condition, **moments, "asked": 9, "failed": 0, "longest_gap_s": 0.1}

    samples = fill(folder, recovery.EXPERIMENT, {"kill": 7, "freeze": 5}, row)
    figure = recovery.EXPERIMENT.figures(samples)["moments"]
    for axis, condition in zip(figure.axes, ("kill", "freeze"), strict=True):
        shown = steps(axis)
        for field in recovery.MOMENTS:
            is_distribution_of(shown[field.removesuffix("_s")], column(folder, condition, field))


def test_a_picture_that_cannot_be_drawn_here_is_kept(folder):
    """A report written without some extra shows what an earlier run drew."""
    samples = fill(folder / "uplink", uplink.EXPERIMENT, {"replicas-1": 1}, lambda *_: {
        "replicas": 1, "requests": 9, "directly": 1.0, "gateway": 1.0
    })  # fmt: skip
    before = "".join(report.section(folder, uplink.EXPERIMENT, samples))

    class Bare(uplink.Uplink):
        def figures(self, samples):
            raise ModuleNotFoundError("No module named 'renderer'")

    assert "".join(report.section(folder, Bare(), samples)) == before
    assert before.count("<img ") == 1
