"""Detection, segmentation and picking: what can be said without running them, and their faults.

That a faulted run was faulted is asserted of the committed samples, below `docs/results`.
"""

from __future__ import annotations

import random
import threading
from types import SimpleNamespace

import pytest

from tests.bench.rig import ROOT
from tests.estimates import mean, median
from tests.evaluation import comparing, contending
from tests.evaluation.comparing import CONDITIONS
from tests.evaluation.experiments import detection, picking, picking_figures, segmentation
from tests.evaluation.samples import Samples, Store
from tests.needs import needs

RESULTS = ROOT / "docs" / "results"


def committed(experiment, conditions) -> Samples:
    store = Store(RESULTS / experiment.name, experiment.fields)
    samples = store.samples(conditions)
    if not all(samples[c] for c in conditions):
        pytest.skip(f"no results of {experiment.name} are committed")
    return samples


def made_up(experiment, latencies, **more) -> Samples:
    """Rows of an experiment with these latencies for each of the four conditions."""
    blank = dict.fromkeys(experiment.fields, "")
    return Samples(
        {
            condition: [
                {"trial": i, "began_at": 0.0, "load": 0.0, **blank, "ok": 1, "latency_s": s, **more}
                for i, s in enumerate(latencies[condition])
            ]
            for condition in CONDITIONS
        }
    )


def steady(seconds: float, count: int = 30) -> list[float]:
    source = random.Random(round(seconds * 1000))
    return [seconds + source.uniform(0, 0.01) for _ in range(count)]


FAULTED = {
    "single": steady(0.09),
    "two": steady(0.09),
    "single-fault": steady(0.19),
    "two-fault": steady(0.09),
}


class TestFindings:
    def test_a_ratio_is_of_one_server_over_two_replicas(self):
        samples = made_up(detection.EXPERIMENT, FAULTED, rtt_west_1_s=0.1)
        found = {f.what: f for f in detection.EXPERIMENT.findings(samples)}
        ours = found["with the fault, mean: one server / two replicas"].ours
        assert ours.value == pytest.approx(0.195 / 0.095, rel=0.02)
        assert found["without a fault, mean: one server / two replicas"].ours.value == (
            pytest.approx(1, abs=0.02)
        )

    @pytest.mark.parametrize("experiment", [detection.EXPERIMENT, segmentation.EXPERIMENT])
    @pytest.mark.parametrize("slow", [0.05, 9.0])
    def test_every_difference_has_a_reason(self, experiment, slow):
        samples = made_up(experiment, {**FAULTED, "single-fault": steady(slow)}, busy=0.5)
        samples = Samples({c: [{**r, "rtt_west_1_s": 0.1} for r in samples[c]] for c in samples})
        found = experiment.findings(samples)
        assert len(found) == 6
        assert all(each.why for each in found)

    @needs("matplotlib")
    def test_the_pictures_hold_the_samples_and_nothing_else(self):
        samples = made_up(detection.EXPERIMENT, FAULTED)
        figure = detection.EXPERIMENT.figures(samples)["latency"]
        healthy, faulted = figure.axes[2], figure.axes[5]
        drawn = {line.get_label(): line for axis in (healthy, faulted) for line in axis.lines}
        for condition in CONDITIONS:
            line = drawn[comparing.LABELS[condition]]
            assert list(line.get_xdata()) == sorted(FAULTED[condition])
        for axis in (figure.axes[0], figure.axes[1], figure.axes[3], figure.axes[4]):
            assert sum(bar.get_height() for bar in axis.patches) == 30


class TestContender:
    @pytest.fixture
    def asked(self, monkeypatch):
        """Callers that note whom they are asked for, and answer when told."""
        asked, answer = [], threading.Event()

        class Caller:
            def __init__(self, domain, name):
                self.domain = domain

            def wait(self, service, type):
                pass

            def call(self, service, type, request, timeout_s):
                asked.append((self.domain, service, request))
                answer.wait(60)
                return request, 0.0

            def close(self):
                pass

        monkeypatch.setattr(contending, "Caller", Caller)
        return SimpleNamespace(calls=asked, answer=answer)

    def test_machines_take_turns_and_are_busy_until_they_have_answered(self, asked):
        domains, services = {"a": 5, "b": 6}, {"a": "/a", "b": "/b"}
        with contending.Contender(domains, services, None, "q") as contender:
            contender.begin(["a", None], 3600.0)
            end = threading.Event()
            for _ in range(6000):
                if contender.busy(["a"]) and asked.calls:
                    break
                end.wait(0.01)
            assert asked.calls == [(5, "/a", "q")]
            assert (contender.busy(["a", "b"]), contender.busy(["b"])) == (1, 0)
            asked.answer.set()
            contender.stop()
            assert contender.busy(["a", "b"]) == 0
            contender.begin(["b", "a"], 0.001)
            for _ in range(6000):
                if len(asked.calls) >= 4:
                    break
                end.wait(0.01)
            contender.stop()
        assert {domain for domain, _, _ in asked.calls[1:3]} == {5, 6}


class TestStory:
    """The story of picking with an arm and machines that are made up."""

    @pytest.fixture
    def story(self, monkeypatch):
        world = SimpleNamespace(now=1000.0, rows=[], generation={0: 1, 1: 1}, gone={}, log=[])

        def ask():
            """A request each 0.2 s; a machine is back 3 s after it was ended."""
            world.now += 0.2
            for slot, at in list(world.gone.items()):
                if world.now >= at + 3:
                    del world.gone[slot]
                    world.generation[slot] += 1
            left = [slot for slot in (0, 1) if slot not in world.gone]
            slot = left[len(world.rows) % len(left)]
            winner = f"{slot}.{world.generation[slot]}"
            row = {"began_at": str(world.now), "latency_s": "0.01", "answered": "1", "cycle": "1"}
            more = {"found": "0", "error_m": "", "scan": "0", "state": "", "winner": winner}
            world.rows.append({**row, **more})

        class Pools:
            def ready(self, pool):
                return [
                    {"slot": s, "generation": g, "location": f"local/r{s}/a"}
                    for s, g in world.generation.items()
                    if s not in world.gone
                ]

            def wait_whole(self, pool):
                assert len(self.ready(pool)) == 2

            def fogft(self, *words):
                world.log.append(words[:3])
                if words[1] == "kill":
                    world.gone[int(words[2])] = world.now

            def wait(self, condition, what, limit_s):
                while not condition():
                    ask()

        class Arm:
            summary = {}

            def rows(self):
                return world.rows

            def finish(self):
                self.summary = {"cycles": 7, "failed_cycles": 0}

        monkeypatch.setattr(picking.time, "time", lambda: world.now)
        world.story = picking.Story(Pools(), Arm(), 100)
        return world

    def test_it_goes_from_a_to_e_and_loses_no_request(self, story):
        rows = [story.story.row(number) for number in range(100)]
        phases = [row["phase"] for row in rows]
        assert phases == sorted(phases)
        assert set(phases) == set("ABCDE")
        assert sum(row["passed"] for row in rows) == len(story.rows)
        assert {row["winner"] for row in rows if row["phase"] == "B"} == {"1"}
        assert {row["winner"] for row in rows if row["phase"] == "D"} == {"0"}
        assert rows[-1]["cycles"] == 7
        kills = [words[2] for words in story.log if words[1] == "kill"]
        assert kills == ["0", "1"]

    def test_a_failure_that_is_passed_over_is_counted(self, story):
        for number in range(55):
            story.story.row(number)
        taken = len(story.rows)
        while len(story.rows) < taken + 5:
            story.story.pools.wait(lambda: len(story.rows) >= taken + 5, "", 0)
        story.rows[taken + 1]["answered"] = "0"
        row = story.story.row(55)
        assert (row["passed"], row["passed_failed"]) == (5, 1)

    @needs("matplotlib")
    def test_the_timeline_draws_every_request(self):
        rows = [
            {"at_s": float(i), "latency_s": 0.01 + i / 1000, "phase": "ABCDE"[i // 4], "winner": w}
            for i, w in enumerate([0, 1] * 10)
        ]
        figure = picking_figures.timeline(rows, picking.PHASES)
        points = {}
        for line in figure.axes[0].lines:
            points[line.get_label()] = list(zip(line.get_xdata(), line.get_ydata(), strict=True))
        for slot in (0, 1):
            expected = [(r["at_s"], r["latency_s"]) for r in rows if r["winner"] == slot]
            assert points[f"#{slot + 1} answered first"] == expected


class TestCommitted:
    """The faults took hold, by columns that are not the latencies they explain."""

    def test_the_path_to_one_region_was_100_ms_longer_and_no_other_one(self):
        samples = committed(detection.EXPERIMENT, CONDITIONS)
        west = {c: median(samples.column(c, "rtt_west_1_s")) for c in CONDITIONS}
        for kind in ("single", "two"):
            assert west[f"{kind}-fault"] - west[kind] == pytest.approx(0.1, abs=0.02)
        other = [median(samples.column(c, "rtt_west_2_s")) for c in ("two", "two-fault")]
        assert other[0] == pytest.approx(other[1], abs=0.02)
        assert mean(samples.column("single-fault", "latency_s")) > 0.1

    def test_servers_were_busy_with_the_second_client_and_only_then(self):
        samples = committed(segmentation.EXPERIMENT, CONDITIONS)
        assert set(samples.column("single", "busy") + samples.column("two", "busy")) == {0}
        assert 0.25 < mean(samples.column("single-fault", "busy")) < 0.75
        assert 0.5 < mean(samples.column("two-fault", "busy")) <= 2

    def test_no_cycle_failed_while_both_servers_were_ended_in_turn(self):
        (rows,) = committed(picking.EXPERIMENT, [picking.ALL]).values()
        assert "".join(sorted({row["phase"] for row in rows})) == "ABCDE"
        assert {row["winner"] for row in rows if row["phase"] == "B"} == {1}
        assert {row["winner"] for row in rows if row["phase"] == "D"} == {0}
        assert rows[-1]["cycles"] > 5
        assert rows[-1]["failed_cycles"] == 0
        assert sum(row["passed_failed"] for row in rows) == 0
        assert all(row["ok"] for row in rows)
