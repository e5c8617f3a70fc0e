"""Each experiment by what can be said without running it, and with rows that are made up."""

from __future__ import annotations

import random
import re

import pytest

from fogft.planning.availability import replicas_needed, unavailability
from tests.evaluation import registry, report
from tests.evaluation.experiment import Scale
from tests.evaluation.experiments import costs, failures, planning
from tests.evaluation.experiments.planning import Condition, contended_trials
from tests.evaluation.samples import COMMON, Samples

EXPERIMENTS = {name: registry.load(name) for name in registry.MODULES}
SCALES = [Scale(name) for name in ("quick", "normal", "full")]


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_an_experiment_says_what_it_is(name):
    experiment = EXPERIMENTS[name]
    assert experiment.name == name
    assert min(len(experiment.claim), len(experiment.method)) > 40
    assert set(experiment.measures) <= set(experiment.fields)
    assert not set(experiment.fields) & set(COMMON)
    assert len(set(experiment.fields)) == len(experiment.fields)


@pytest.mark.parametrize("scale", SCALES, ids=lambda scale: scale.name)
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_conditions_can_be_files_and_have_trials(name, scale):
    trials = EXPERIMENTS[name].trials(scale)
    assert trials
    assert all(re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", condition) for condition in trials)
    assert min(trials.values()) > 0


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_more_is_run_the_longer_it_may_take(name):
    quick, normal, full = (sum(EXPERIMENTS[name].trials(scale).values()) for scale in SCALES)
    assert quick <= normal <= full


def test_the_papers_number_of_trials_is_run():
    """100 for motion planning, unless it is to be quick."""
    assert min(EXPERIMENTS["planning"].trials(Scale("normal")).values()) >= 100


# -- planning ------------------------------------------------------------------------------------


@pytest.mark.parametrize("trials", [8, 100, 300])
@pytest.mark.parametrize("slot", [0, 1, 2])
def test_two_in_a_hundred_requests_are_contended(trials, slot):
    """Exactly so many, at least one, so that a contended condition is never a clean one."""
    found = contended_trials(Condition("cubicles", 3, contended=True), slot, trials)
    assert len(found) == max(1, trials * 2 // 100)
    assert found <= set(range(trials))


def test_nothing_is_contended_in_a_clean_condition():
    assert contended_trials(Condition("cubicles", 3, contended=False), 0, 100) == frozenset()


def test_replicas_are_contended_independently():
    """Else both would be slow at once, and replication could not help."""
    drawn = [contended_trials(Condition("home", 2, contended=True), s, 300) for s in (0, 1)]
    assert drawn[0] != drawn[1]
    assert len(drawn[0] & drawn[1]) <= 1


def test_a_conditions_name_tells_what_it_is():
    condition = Condition("twist", 2, contended=True)
    assert Condition.of(condition.name) == condition


def made_up(slow: float) -> Samples:
    """Exponential trials of one scene; the one server is so many times slower than two."""
    source = random.Random(1)

    def row(trial: int, scale: float) -> dict:
        seconds = source.expovariate(1 / scale)
        return {
            "trial": trial, "began_at": 0.0, "load": 0.0, "ok": 1, "latency_s": seconds,
            "checks": int(seconds * 1e5) + 1, "search_s": seconds, "winner": 0,
            "contended": 0, "stolen_s": 0.0, "fault": "",
        }  # fmt: skip

    means = {1: slow, 2: 1.0, 3: 0.7}
    return Samples(
        {
            Condition("cubicles", n, contended).name: [row(t, means[n]) for t in range(100)]
            for contended in (False, True)
            for n in planning.REPLICAS
        }
    )


@pytest.mark.parametrize(
    ("slow", "words"), [(1.22, "within our interval"), (0.3, "two cores"), (9.0, "spread more")]
)
def test_every_difference_from_the_paper_is_explained(slow, words):
    """Each finding has a reason, and the right one for where the paper's figure lies."""
    found = planning.EXPERIMENT.findings(made_up(slow))
    assert len(found) == 4  # mean and P99, clean and contended
    assert all(finding.why for finding in found)
    assert words in next(f for f in found if "mean, clean" in f.what).why


# -- costs ---------------------------------------------------------------------------------------


def test_the_papers_cost_table_is_as_printed():
    assert [(a.name, a.usd_per_hour) for a in costs.PAPER] == [
        ("YOLO", (0.40, 0.80, 0.34)),
        ("SAM", (0.53, 1.06, 0.44)),
        ("MPT-Home", (1.79, 3.58, 1.69)),
        ("MPT-Cubicles", (1.79, 3.58, 1.69)),
        ("MPT-TwistyCool", (3.58, 7.16, 1.68)),
        ("Pick-Scan-Place", (0.40, 0.80, 0.34)),
    ]


# -- failures ------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", failures.TARGETS)
def test_the_corrected_formula_is_what_fogft_uses_and_the_printed_one_is_not(target):
    one = unavailability(failures.UPTIME_S, failures.RECOVERY_S)
    assert failures.corrected(one, 1 - target) == replicas_needed(1 - one, target)
    assert failures.printed(one, 1 - target) == 1


def test_the_papers_own_example():
    """2.17 % for one VM; below 0.05 % for two, and 99.99 % needs three."""
    one = unavailability(failures.UPTIME_S, failures.RECOVERY_S)
    assert 100 * one == pytest.approx(2.17, abs=0.005)
    assert one**2 < 0.0005
    assert failures.corrected(one, 0.0005) == 2
    assert failures.corrected(one, 0.0001) == 3


# -- the report ----------------------------------------------------------------------------------


def test_the_table_of_measures_has_the_samples_numbers():
    samples = made_up(2.0)
    table = report.measured(planning.EXPERIMENT, samples)
    row = next(r for r in table.rows if r[:2] == ["cubicles-clean-1", "latency_s"])
    values = sorted(r["latency_s"] for r in samples["cubicles-clean-1"])
    assert row[2:4] == ["100", f"{sum(values) / 100:.4g}"]
    assert row[4] == f"{(values[49] + values[50]) / 2:.4g}"
    assert row[6] == f"{values[-1]:.4g}"
