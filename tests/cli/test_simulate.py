"""``fogft simulate``: its table, its JSON, its plot, and what it refuses."""

from __future__ import annotations

import json

import pytest

from fogft.cli import main
from fogft.cli.simulate import percent
from tests.needs import needs

POOL = """\
name: planner
resources: {use_spot: true, any_of: [{infra: local/us-west-2}, {infra: local/us-east-1}]}
run: python3 planner_service.py
fogft:
  replicas: 2
  services: [{name: /plan, type: nav_msgs/srv/GetPlan}]
"""
SHORT = ["--days", "0.25", "--seeds", "2"]


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "pool.yaml"
    path.write_text(POOL)
    return path


@pytest.fixture
def traces(tmp_path):
    folder = tmp_path / "traces"
    folder.mkdir()
    for zone, data in (("us-west-2a", [1, 0] * 200), ("us-east-1b", [2] * 400)):
        value = {"metadata": {"gap_seconds": 600}, "data": data}
        (folder / f"{zone}_small.json").write_text(json.dumps(value))
    return folder


def test_a_table_of_policies_side_by_side(file, capsys):
    assert main.run(["simulate", str(file), *SHORT]) == 0
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert lines[0].split()[:2] == ["POLICY", "AVAILABLE"]
    assert [line.split("  ")[0] for line in lines[1:6]] == [
        *("fogft", "one on-demand", "static, any of 2"),
        *("SkyServe, spot only", "SkyServe, fallback"),
    ]
    assert "2 replicas wanted; 2 markets (simulated) of 0.25 days." in out
    single = next(line for line in lines if line.startswith("one on-demand")).split()
    assert {"1.000", "0.500"} <= set(single)  # of one on-demand machine, and of two
    assert "note: the market is simulated" in err


def test_json_holds_every_seed_and_what_was_assumed(file, capsys):
    assert main.run(["simulate", str(file), *SHORT, "--model", "boot_s=60", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["seeds"] == [0, 1]
    assert found["timing"]["boot_s"] == 60
    assert found["model"]["mttf_s"] == 12_000
    for row in found["policies"]:
        assert len(row["by_seed"]) == 2
        low, high = row["available"]["low"], row["available"]["high"]
        assert 0 <= low <= row["available"]["mean"] <= high <= 1


def test_no_bound_is_told_where_it_would_be_none(file, tmp_path, capsys):
    """It knows one kind of machine, at list prices."""
    prices = tmp_path / "prices"
    prices.mkdir()
    for zone in ("us-west-2a", "us-east-1b"):
        value = {"metadata": {"gap_seconds": 600}, "data": [0.02] * 6}
        (prices / f"{zone}_small.json").write_text(json.dumps(value))
    groups = "  groups: [{name: a, replicas: 1}, {name: b, replicas: 1, resources: {cpus: 4+}}]\n"
    grouped = tmp_path / "grouped.yaml"
    grouped.write_text(POOL.replace("  replicas: 2\n", groups))
    for words in ([str(file), "--prices", str(prices)], [str(grouped)]):
        assert main.run(["simulate", *words, *SHORT, "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert "omniscient" not in [row["policy"] for row in found["policies"]]
        assert any("prices end before" in note for note in found["notes"]) is ("--prices" in words)
    assert main.run(["simulate", str(file), *SHORT, "--json"]) == 0
    assert '"omniscient"' in capsys.readouterr().out


def test_a_pool_that_can_buy_nothing_is_not_called_the_cheapest(file, capsys):
    file.write_text(POOL + "  max_usd_per_hour: 0.001\n")
    assert main.run(["simulate", str(file), *SHORT]) == 0
    out = capsys.readouterr().out
    assert "Cheapest" not in out
    assert "No replica was ever ready" in out


@pytest.mark.parametrize(
    "words", [["simulate", "x.yaml", "--days", "nan"], ["export", "x", "y", "--hours", "nan"]]
)
def test_what_is_no_number_is_refused_whatever_asks_for_one(words, capsys):
    assert main.run(words) == 2
    assert "`nan` is not a number" in capsys.readouterr().err


def test_recorded_traces_are_replayed(file, traces, capsys):
    assert main.run(["simulate", str(file), *SHORT, "--traces", str(traces), "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["market"] == "recorded"
    assert json.loads(out)["locations"] == 2
    assert "note: 2 of the pool's 4 locations have no trace" in err


def test_markets_like_the_traces_are_made_up(file, traces, capsys):
    arguments = ["--traces", str(traces), "--fit", "--model", "mttr_s=900", "--json"]
    assert main.run(["simulate", str(file), *SHORT, *arguments]) == 0
    model = json.loads(capsys.readouterr().out)["model"]
    assert model["mttf_s"] > 600
    assert model["mttr_s"] == 900


@needs("matplotlib")
@pytest.mark.parametrize(("name", "magic"), [("a.png", b"\x89PNG"), ("a.svg", b"<?xml")])
def test_a_plot_is_drawn(file, tmp_path, name, magic):
    assert main.run(["simulate", str(file), *SHORT, "--plot", str(tmp_path / name)]) == 0
    drawn = (tmp_path / name).read_bytes()
    assert drawn.startswith(magic)
    assert len(drawn) > 5_000


@needs("matplotlib")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--model", "mttf_s=-1"], "`mttf_s` must be from 1 to 1e+12"),
        (["--fit"], "`--fit` needs traces"),
        (["--traces", "nowhere"], "nowhere: is not a folder of traces"),
        (["--plot", "a.bmp"], "cannot draw a `.bmp` file"),
        (["--plot", "no/such/a.png"], "there is no folder"),
        (["--seeds", "10000", "--days", "3650"], "more than 1000000 pool-days"),
    ],
)
def test_what_cannot_be_is_told_before_anything_runs(file, capsys, arguments, message):
    assert main.run(["simulate", str(file), *arguments]) == 1
    assert message in capsys.readouterr().err


def test_traces_and_numbers_that_contradict_them_are_refused(file, traces, capsys):
    arguments = ["--traces", str(traces), "--model", "mttf_s=3"]
    assert main.run(["simulate", str(file), *arguments]) == 1
    assert "`mttf_s` is taken from the traces" in capsys.readouterr().err


def test_a_region_that_does_not_exist_is_told_with_its_line(file, capsys):
    file.write_text(POOL.replace("us-east-1", "us-east-9"))
    assert main.run(["simulate", str(file), *SHORT]) == 1
    assert "pool.yaml:2: resources.any_of[1].infra: the local cloud has no region `us-east-9`" in (
        capsys.readouterr().err
    )


def test_a_trace_of_another_region_is_told(file, traces, capsys):
    (traces / "mars-1a.json").write_text('{"metadata": {"gap_seconds": 60}, "data": [1]}')
    assert main.run(["simulate", str(file), *SHORT, "--traces", str(traces)]) == 1
    assert "there is no location `mars-1a`" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("share", "text"),
    [(1.0, "100.00 %"), (0.99996, "99.996 %"), (0.5, "50.00 %"), (0.99999999999, "99.99999 %")],
)
def test_a_share_is_never_rounded_up_to_all(share, text):
    assert percent(share) == text
