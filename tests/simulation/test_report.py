"""The simulation report in docs/: that it can be written, and that its figures still hold."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from fogft.simulation.comparison import policies, unlogged
from fogft.simulation.world import World
from tests.simulation import report

FIGURES = json.loads((report.FOLDER / "figures.json").read_text())


def test_the_report_is_of_the_markets_that_the_script_has():
    assert list(FIGURES["markets"]) == list(report.MARKETS)
    for name, scenario in report.scenarios().items():
        kept = FIGURES["markets"][name]
        assert kept["seeds"] == list(scenario.seeds)
        assert kept["model"] == json.loads(json.dumps(kept["model"] | vars(scenario.model)))


@pytest.mark.parametrize("policy", ["fogft", "static, any of 2", "SkyServe, fallback"])
def test_the_figures_of_the_first_seed_still_hold(policy):
    """Within what small changes of the planner may do; else run `scripts/simulate`."""
    name, scenario = next(iter(report.scenarios().items()))
    [row] = [r for r in FIGURES["markets"][name]["policies"] if r["policy"] == policy]
    world = World(scenario.market(0), seed=0, length_s=scenario.length_s, settle_s=report.SETTLE_S)
    with unlogged():
        outcome = world.run(policies(scenario)[policy](world)).outcome()
    kept = row["by_seed"][0]
    assert outcome.available == pytest.approx(kept["available"], abs=0.01)
    assert outcome.usd_per_hour == pytest.approx(kept["usd_per_hour"], rel=0.05)


def test_the_report_says_what_its_figures_say():
    """Each table is in the page as it follows from the figures."""
    page = (report.FOLDER / "README.md").read_text()
    for row in FIGURES["arithmetic"]:
        assert f"{100 * row['expected']:.3g} % | {100 * row['simulated']['mean']:.3g} %" in page


def test_what_availability_expects_is_about_what_is_simulated():
    """Within a factor of 3, over the whole grid."""
    for row in FIGURES["arithmetic"]:
        assert 1 / 3 < row["simulated"]["mean"] / row["expected"] < 3


def test_there_is_a_picture():
    assert (report.FOLDER / "planner.png").read_bytes().startswith(b"\x89PNG")


def test_a_page_can_be_made_of_any_simulation():
    name, scenario = next(iter(report.scenarios(quick=True).items()))
    found = report.simulate_scenario(replace(scenario, days=0.1, seeds=(0,)))
    lines = list(report.page({name: found}, FIGURES["arithmetic"]))
    assert sum(line.startswith("| **fogft**") for line in lines) == 1
