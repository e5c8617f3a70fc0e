"""What the planner is worth in markets that are hard, beside a page of naive code."""

from __future__ import annotations

import pytest

from fogft import template_files
from fogft.simulation.report import simulate
from tests.needs import needs
from tests.simulation.trials import KINDS, Trial, run

NIGHT = needs("night")
HARD = ["nine", "scarce", "cpu", "tight", "regions", "hours without"]


@pytest.mark.parametrize(
    "market", [name if name == "nine" else pytest.param(name, marks=NIGHT) for name in HARD]
)
def test_with_a_notice_it_is_up_as_often_as_the_naive_policy_at_about_its_cost(market):
    ours, naive = (run(Trial(market, policy)) for policy in ("fogft", "naive"))
    assert ours.available >= naive.available - 0.0001
    assert ours.available >= 0.9995
    assert ours.usd_per_hour <= 1.08 * naive.usd_per_hour


def test_where_zones_flap_it_is_up_far_more_often_than_the_naive_policy():
    """A zone has room for twelve minutes, then none for eight."""
    ours, naive = (run(Trial("flapping", policy, days=1)) for policy in ("fogft", "naive"))
    assert ours.available >= 0.9998 > naive.available
    assert ours.usd_per_hour <= 1.15 * naive.usd_per_hour


def test_where_spot_machines_hardly_vanish_it_costs_no_more_than_them():
    outcome = run(Trial("rich", "fogft"))
    assert outcome.available == 1.0
    assert outcome.usd_per_hour <= 2 * 0.3 * 1.01


@NIGHT
def test_the_shipped_planner_is_the_cheapest_that_is_as_available():
    """Cheaper than one on-demand machine, and up more often than the others that cost less."""
    report = simulate(template_files.folder() / "planner" / "pool.yaml", days=4.0, seeds=(0, 1))
    assert report.target >= 0.9995
    assert report.cheapest is not None
    assert report.cheapest.name == "fogft"


@pytest.mark.parametrize("notice_s", [0.0, 120.0])
def test_all_trials_can_be_run(notice_s):
    for market in KINDS:
        outcome = run(Trial(market, "fogft", days=0.2, notice_s=notice_s))
        assert outcome.seconds == pytest.approx(0.2 * 86_400)
        assert outcome.mean_ready > 1
