"""What is run, in which order, and what an interruption leaves."""

from __future__ import annotations

import contextlib
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.evaluation.errors import EvaluationError
from tests.evaluation.experiment import Defaults, Scale
from tests.evaluation.running import check_settings, complete, missing, order
from tests.evaluation.samples import Store

plans = st.dictionaries(st.sampled_from(["one", "two", "three"]), st.integers(0, 6))


class Counting(Defaults):
    """Two conditions; fails after as many trials as it is told."""

    name = title = claim = method = "counting"
    fields = ("latency_s", "winner")

    def __init__(self, fail_after: int = 1000, *, whole: bool = False) -> None:
        super().__init__(whole=whole)
        self.fail_after = fail_after
        self.ran: list[tuple[str, int]] = []
        self.closed = 0

    def trials(self, scale):
        return {"one": 5, "two": 3}

    @contextlib.contextmanager
    def session(self, stage):
        try:
            yield self.run
        finally:
            self.closed += 1

    def run(self, condition, trial):
        if len(self.ran) == self.fail_after:
            raise EvaluationError("no pool")
        self.ran.append((condition, trial))
        return {"latency_s": 0.1 + trial / 3, "winner": "0.1"}

    def findings(self, samples):
        return ()

    def figures(self, samples):
        return {}


def run(experiment, folder, **more):
    return complete(experiment, Store(folder, experiment.fields), Scale("quick"), {}, **more)


@given(plans, st.integers(0, 5))
def test_the_order_has_each_trial_once_and_round_after_round(trials, seed):
    """No condition runs ahead of another, so that a busy moment meets all alike."""
    found = order(trials, seed)
    assert sorted(found) == sorted((c, n) for c, count in trials.items() for n in range(count))
    rounds = [number for _, number in found]
    assert rounds == sorted(rounds)
    assert found == order(trials, seed)


def test_conditions_do_not_always_come_in_the_same_turn():
    firsts = {condition for condition, _ in order({"one": 30, "two": 30})[::2]}
    assert firsts == {"one", "two"}


@pytest.mark.parametrize("after", range(8))
def test_a_stopped_run_goes_on_where_it_stopped(tmp_path, after):
    """Each trial is run once in all, wherever the first run ended."""
    first, second = Counting(after), Counting()
    with pytest.raises(EvaluationError, match="no pool"):
        run(first, tmp_path)
    samples = run(second, tmp_path)
    assert first.closed == 1
    assert sorted(first.ran + second.ran) == sorted(order(first.trials(None)))
    assert {c: len(rows) for c, rows in samples.items()} == {"one": 5, "two": 3}
    assert samples.column("two", "latency_s") == [0.1, 0.1 + 1 / 3, 0.1 + 2 / 3]


def test_a_complete_run_is_not_run_again(tmp_path):
    run(Counting(), tmp_path)
    again, told = Counting(), []
    run(again, tmp_path, advance=lambda done, all: told.append((done, all)))
    assert (again.ran, again.closed, told) == ([], 0, [(8, 8)])


def test_what_cannot_go_on_in_its_middle_begins_again(tmp_path):
    with pytest.raises(EvaluationError):
        run(Counting(3, whole=True), tmp_path)
    again, said = Counting(whole=True), []
    samples = run(again, tmp_path, say=said.append)
    assert len(again.ran) == sum(map(len, samples.values())) == 8
    assert "begins again" in said[0]


@pytest.mark.parametrize("torn", ["3,17", '3,"1', "3,1.0,0.5,0.3,0."])
def test_a_torn_last_line_is_dropped_and_its_trial_run_again(tmp_path, torn):
    """As a killed process or a full disk leaves it."""
    run(Counting(), tmp_path)
    path = tmp_path / "one.csv"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:-1]) + torn)
    store = Store(tmp_path, Counting.fields)
    lost = {("one", int(lines[-1].split(",")[0]))}
    assert set(missing(store, {"one": 5, "two": 3})) == lost
    assert len(run(Counting(), tmp_path)["one"]) == 5


def test_a_file_of_another_version_is_not_mixed_with(tmp_path):
    (tmp_path / "one.csv").write_text("trial,speed\n0,1.0\n")
    with pytest.raises(EvaluationError, match="not a file of this experiment"):
        run(Counting(), tmp_path)


@pytest.mark.parametrize("row", [{"latency_s": 1.0}, {"latency_s": 1.0, "winner": "", "odd": 1}])
def test_a_row_has_the_columns_of_its_file(tmp_path, row):
    common = {"trial": 0, "began_at": 0.0, "load": 0.0}
    with pytest.raises(ValueError, match="missing or unknown"):
        Store(tmp_path, Counting.fields).append("one", {**common, **row})
    assert os.listdir(tmp_path) == []


@given(value=st.one_of(st.floats(allow_nan=False, allow_infinity=False), st.integers()))
def test_a_number_is_read_as_it_was_written(tmp_path_factory, value):
    store = Store(tmp_path_factory.mktemp("csv"), ["x"])
    row = {"trial": 0, "began_at": 1.5, "load": 0.0, "x": value}
    store.append("one", row)
    assert store.read("one") == [row]


def test_text_with_commas_quotes_and_newlines_survives(tmp_path):
    store = Store(tmp_path, ["x"])
    rows = [
        {"trial": n, "began_at": 1.5, "load": 0.0, "x": text}
        for n, text in enumerate(["a,b", 'say "no"', "two words", ""])
    ]
    for row in rows:
        store.append("one", row)
    assert store.read("one") == rows


def test_results_of_other_settings_are_not_mixed(tmp_path):
    path = tmp_path / "results" / "settings.json"
    check_settings(path, {"scale": "quick", "options": {}})
    check_settings(path, {"scale": "quick", "options": {}})
    with pytest.raises(EvaluationError, match=r"\(scale\).*--into"):
        check_settings(path, {"scale": "full", "options": {}})


def test_what_a_killed_run_left_is_removed_first(tmp_path):
    """Its work folder is not taken for the new session's, whose folder is empty."""
    left = tmp_path / ".work" / "pools" / "something"
    left.mkdir(parents=True)
    said = []

    class Looking(Counting):
        @contextlib.contextmanager
        def session(self, stage):
            assert list(stage.folder.iterdir()) == []
            yield self.run

    run(Looking(), tmp_path, say=said.append)
    assert "ending its pools" in said[0]
    assert not (tmp_path / ".work").exists()
