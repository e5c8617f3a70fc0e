"""Made-up markets have the means and correlations that were asked for, and can be fitted back."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest

from fogft.errors import FogftError
from fogft.simulation import fitting, model
from fogft.simulation.model import MarketModel, Timing, generate, rates
from fogft.simulation.timeline import of_samples
from tests.needs import needs
from tests.simulation.markets import INDEPENDENT

LOCATIONS = [f"c{i}/r{j}/z{k}" for i in range(2) for j in range(2) for k in range(2)]
YEARS = 3 * 365 * 86_400.0


@pytest.mark.parametrize(
    "asked",
    [
        pytest.param(INDEPENDENT, marks=needs("night")),
        MarketModel(),
        pytest.param(
            MarketModel(mttf_s=54_000.0, mttr_s=7_200.0, correlation_region=0.22,
                        correlation_cloud=0.22, correlation_world=0.1, together=0.0),
            marks=needs("night"),
        ),
        MarketModel(mttf_s=7_200.0, mttr_s=7_200.0, correlation_region=0.5,
                    correlation_cloud=0.1, together=0.4, regime_s=86_400.0),
    ],
    ids=["independent", "default", "everywhere", "strong"],
)  # fmt: skip
def test_a_made_up_market_is_as_its_model_says(asked):
    """Means within 5 %, correlations within 0.03, over three years of eight zones."""
    found = fitting.fit(generate(asked, LOCATIONS, YEARS, random.Random(7)))
    assert found.mttf_s == pytest.approx(asked.mttf_s, rel=0.05)
    assert found.mttr_s == pytest.approx(asked.mttr_s, rel=0.05)
    assert found.correlation_region == pytest.approx(asked.correlation_region, abs=0.03)
    assert found.correlation_cloud == pytest.approx(asked.correlation_cloud, abs=0.03)
    assert found.correlation_world == pytest.approx(asked.correlation_world, abs=0.03)
    assert found.together == pytest.approx(asked.together, abs=0.03)


def test_each_zone_can_have_its_own_times_and_is_fitted_back():
    """From one hour to ten with room; correlated as before."""
    zones = {place: (3600.0 * (1 + i), 1800.0 * (1 + i % 3)) for i, place in enumerate(LOCATIONS)}
    lines = generate(MarketModel(), LOCATIONS, YEARS, random.Random(7), zones)
    found = fitting.of_zones(lines)
    for place, (mttf_s, mttr_s) in zones.items():
        assert found[place][0] == pytest.approx(mttf_s, rel=0.1)
        assert found[place][1] == pytest.approx(mttr_s, rel=0.1)
    assert fitting.fit(lines).correlation_region > 0.2
    assert fitting.of_zones({"c/r/z": of_samples([1, 1, 1], 60)}) == {}


def test_the_same_seed_makes_the_same_market():
    one, two, other = (
        generate(MarketModel(), LOCATIONS, 86_400.0, random.Random(seed)) for seed in (1, 1, 2)
    )
    assert one == two
    assert one != other


def test_correlation_of_what_is_known():
    """Of equal series 1, of opposite ones -1, of a constant one none."""
    waves = of_samples([1, 1, 0, 0, 1, 1, 0, 0], 60)
    assert fitting.correlation(waves, waves) == pytest.approx(1.0)
    assert fitting.correlation(waves, of_samples([0, 0, 1, 1] * 2, 60)) == pytest.approx(-1.0)
    assert fitting.correlation(waves, of_samples([1] * 8, 60)) is None


def test_correlations_that_no_market_has_are_lowered_together():
    usual = MarketModel()
    assert fitting.feasible(usual) == usual
    seen = replace(usual, correlation_region=0.95, correlation_cloud=0.06)
    with pytest.raises(FogftError, match="no market has correlations"):
        rates(seen)
    found = fitting.feasible(seen)
    assert rates(found).strikes > 0
    assert 0.5 < found.correlation_region < 0.95
    assert found.correlation_cloud == pytest.approx(0.06 * found.correlation_region / 0.95)


def test_traces_that_never_change_cannot_be_fitted():
    with pytest.raises(FogftError, match="no location ever becomes full"):
        fitting.fit({"c/r/z": of_samples([1, 1, 1], 60)})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mttf_s=0", "`mttf_s` must be from 1 to"),
        ("mttf_s=-3", "`mttf_s` must be from 1 to"),
        ("boot_s=soon", "`boot_s` must be a number, not `soon`"),
        ("boot_s=inf", "`boot_s` must be from 0 to .*, not `inf`"),
        ("correlation=1", "`correlation` must be from 0 to 0.95"),
        ("mttf=3", "unknown key `mttf`"),
        ("notice_s", "`notice_s` has no value"),
        ("boot_s=1,boot_s=2", "`boot_s` is given twice"),
    ],
)
def test_a_wrong_model_is_told(text, message):
    with pytest.raises(FogftError, match=message):
        model.read_values(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("correlation_region=0.1,correlation_cloud=0.3", "cannot be more correlated"),
        ("correlation=0.95,regime_s=60", "no market has correlations as high"),
    ],
)
def test_numbers_that_contradict_one_another_are_told(text, message):
    with pytest.raises(FogftError, match=message):
        model.applied(MarketModel(), Timing(), model.read_values(text))


def test_correlation_stands_for_region_and_cloud():
    market, timing = model.applied(
        MarketModel(), Timing(), model.read_values("correlation=0.22, notice_s=30")
    )
    assert (market.correlation_region, market.correlation_cloud) == (0.22, 0.22)
    assert timing.notice_s == 30
