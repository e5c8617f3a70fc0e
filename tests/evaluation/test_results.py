"""The committed results: complete, faulted where they say so, and what the report shows."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any

import pytest

from tests.estimates import median
from tests.evaluation import registry, report, running
from tests.evaluation.experiments.planning import REPLICAS, SCENES, Condition

RESULTS = Path(__file__).parents[2] / "docs" / "results"
PAGE = (RESULTS / "report.html").read_text()
EXPERIMENTS = {name: registry.load(name) for name in registry.MODULES}
FOUND = running.found(RESULTS, EXPERIMENTS)


def test_nothing_is_left_half_run():
    assert set(FOUND) == {folder.name for folder in RESULTS.iterdir() if folder.is_dir()}


@pytest.mark.parametrize(
    "name", ["planning", "costs", "failures", "overhead", "uplink", "recovery", "markets"]
)
def test_an_experiment_is_there_and_complete(name):
    assert name in FOUND


@pytest.mark.parametrize("name", FOUND)
def test_the_reports_figures_are_those_of_the_files(name):
    """Computed anew from the CSV files, to the last digit that is shown."""
    experiment, samples = EXPERIMENTS[name], FOUND[name]
    for finding in experiment.findings(samples):
        assert html.escape(finding.what) in PAGE
        assert html.escape(str(finding.ours)) in PAGE
        assert html.escape(finding.why) in PAGE
    for row in report.measured(experiment, samples).rows:
        assert "".join(f"<td class=n>{html.escape(cell)}" for cell in row) in PAGE


@pytest.mark.parametrize("name", FOUND)
def test_plots_are_there_in_both_forms(name):
    drawn = {path.stem for path in (RESULTS / name).glob("*.png")}
    assert drawn == {path.stem for path in (RESULTS / name).glob("*.svg")} != set()


def test_the_report_needs_no_other_file_to_be_shown():
    assert "src='http" not in PAGE
    assert PAGE.count("src='data:image/") == PAGE.count("<img ")


# -- planning ------------------------------------------------------------------------------------

CONDITIONS = [Condition(s, n, c) for s in SCENES for n in REPLICAS for c in (False, True)]


@pytest.mark.parametrize("condition", CONDITIONS, ids=lambda condition: condition.name)
def test_time_was_stolen_in_contended_trials_and_in_no_other(condition):
    for row in FOUND["planning"][condition.name]:
        assert (row["stolen_s"] > 0) == (row["contended"] > 0)
        assert row["contended"] == 0 or condition.contended


@pytest.mark.parametrize("scene", SCENES)
def test_a_contended_server_searches_much_slower(scene):
    """In checks a second of the request; time was not only stolen while the planner waited."""
    rows = FOUND["planning"][Condition(scene, 1, contended=True).name]
    stolen, spared = ([row for row in rows if bool(row["contended"]) == is_so] for is_so in (1, 0))

    def rates(rows: list[Any], during: str) -> list[float]:
        return [row["checks"] / row[during] for row in rows]

    assert max(rates(stolen, "latency_s")) * 3 < median(rates(spared, "latency_s"))
    # A search of 10 ms may fall between two thefts: not every one is hit itself.
    assert min(rates(stolen, "search_s")) * 3 < median(rates(spared, "search_s"))


@pytest.mark.parametrize("condition", CONDITIONS, ids=lambda condition: condition.name)
def test_every_request_had_a_right_answer_of_one_of_its_replicas(condition):
    rows = FOUND["planning"][condition.name]
    assert [row for row in rows if not row["ok"]] == []
    assert {row["winner"] for row in rows} <= set(range(condition.replicas))


def test_every_replica_wins_now_and_then():
    """Requests are not answered by one replica alone."""
    for condition in CONDITIONS:
        rows = FOUND["planning"][condition.name]
        assert len({row["winner"] for row in rows}) == condition.replicas


# -- the others ----------------------------------------------------------------------------------


def test_no_request_failed_while_replicas_were_killed_and_frozen():
    for condition, rows in FOUND["recovery"].items():
        assert {row["fault"] for row in rows} == {condition}
        assert sum(row["failed"] for row in rows) == 0
        assert min(row["asked"] for row in rows) > 20
        assert all(row["ordered_s"] <= row["whole_s"] for row in rows)


def test_every_call_was_answered():
    assert all(row["ok"] for rows in FOUND["overhead"].values() for row in rows)
