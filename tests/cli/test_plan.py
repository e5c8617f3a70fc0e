"""`fogft plan`: what is shown, as text, JSON and drawing; and what a mistake looks like."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import pytest

from fogft.cli import main
from fogft.pool.commands import composition, preview, startup
from fogft.pool.commands import plan as plans
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.manager import proxy_report
from tests.needs import needs

POOL = """
name: planner
resources: {cpus: 8+, use_spot: true}
run: exec true
fogft:
  services:
    - {name: /plan, type: nav_msgs/srv/GetPlan,
       traffic: {requests_per_s: 10, request_bytes: 500, response_bytes: 100000}}
  placement: {rtt_s: {local/us-west-1: 0.011, local/us-west-2: 0.023}}
"""
HEADER = "Cloud,Region,AvailabilityZone,InstanceType,vCPUs,MemoryGiB,Price,SpotPrice,AsOf\n"


@pytest.fixture
def pool(tmp_path: Path) -> Path:
    file = tmp_path / "pool.yaml"
    file.write_text(POOL)
    return file


def table(tmp_path: Path, *rows: str) -> str:
    file = tmp_path / "prices.csv"
    file.write_text(HEADER + "\n".join(rows) + "\n")
    return str(file)


def test_the_plan_is_what_up_would_launch(pool, capsys):
    """The same planner: the places shown are those that `fogft up` announces."""
    assert main.run(["plan", str(pool), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    announced = preview.order(pool).launches
    assert [(r["slot"], r["usd_per_hour"]) for r in shown["replicas"]] == [
        (launch.slot, launch.offer.usd_per_hour) for launch in announced
    ]
    assert not PoolPaths.of("planner").folder.exists()


def test_every_offer_is_chosen_or_says_why_not(pool, capsys):
    assert main.run(["plan", str(pool), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert len(shown["offers"]) == 10
    assert all(bool(o["slots"]) != bool(o["why_not"]) for o in shown["offers"])
    assert sum(bool(o["slots"]) for o in shown["offers"]) == 2
    by_place = {f"{o['region']}/{o['zone']}": o["why_not"] for o in shown["offers"]}
    assert by_place["us-west-1/b"] == "more expensive: $0.159/h, not $0.153/h (slot 0)"
    assert (
        "cheaper: $0.136/h, not $0.153/h but farther: 23 ms, not 11 ms" in by_place["us-west-2/b"]
    )
    assert "farther: unknown" in by_place["us-east-1/a"]


def test_text_has_costs_availability_and_response(pool, capsys):
    assert main.run(["plan", str(pool)]) == 0
    out = capsys.readouterr().out
    assert "replicas      2 of 2 wanted" in out
    assert "a month" in out
    assert "one on-demand cpu8" in out
    assert "0.996346 expected (0.999527 if replicas failed independently)" in out
    assert "uptime 15 h spot" in out
    assert "LOST" in out
    assert "/h  " not in out.partition("replicas")[0], "without history, no loss rate is shown"
    assert "response      11 ms plus the service's own time; 23 ms while" in out
    assert "(pool file)" in out


def test_egress_is_what_leaves_every_replica(pool, tmp_path, capsys):
    """Two replicas on AWS: 10 responses of 100 kB a second each are 7.2 GB/h, $0.09 a GB."""
    prices = table(
        tmp_path, "aws,us-west-1,a,m,8,32,0.4,0.1,2024-03-15", "aws,us-west-2,a,m,8,32,0.4,0.1,"
    )
    assert main.run(["plan", str(pool), "--prices", prices, "--offline", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["cost"]["egress_usd_per_hour"] == pytest.approx(2 * 3.6 * 0.09)
    assert shown["one_on_demand"]["egress_usd_per_hour"] == pytest.approx(3.6 * 0.09)
    assert shown["cost"]["usd_per_month"] == pytest.approx(730 * (0.2 + 0.648))
    ages = [o["price_age_s"] for o in shown["offers"]]
    assert ages[0] > 86_400
    assert ages[1] is None


def test_egress_is_measured_where_it_is_not_stated(pool, tmp_path, capsys):
    """1000 requests in 100 s with responses of 100 kB: as if the file had said 10 a second."""
    pool.write_text(re.sub(r",\s*traffic: {[^}]*}", "", POOL))
    order = preview.order(pool)
    store = composition.make_store("planner")
    startup.write(store, order.spec, source=order.source, file=pool, cloud="local")
    count = {
        "received": 1000,
        "answered": 500,
        "request_bytes": 500_000,
        "response_bytes": 50_000_000,
    }
    report = {
        "pid": 1,
        "written_at": time.time() - 9000,
        "uptime_s": 100.0,
        "links": [],
        "services": {"/plan": count, "/other": count},
    }
    store.paths.proxy_status.write_text(json.dumps(report))
    prices = table(
        tmp_path, "aws,us-west-1,a,m,8,32,0.4,0.1,2024-03-15", "aws,us-west-2,a,m,8,32,0.4,0.1,"
    )
    asked = ["plan", str(pool), "--prices", prices, "--offline"]
    assert main.run([*asked, "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["cost"]["egress_usd_per_hour"] == pytest.approx(2 * 3.6 * 0.09)
    assert shown["traffic"]["/plan"] == {
        "requests_per_s": 10.0,
        "request_bytes": 500.0,
        "response_bytes": 100_000.0,
        "source": "measured",
        "measured_over_s": 100.0,
    }
    assert main.run(asked) == 0
    assert "/plan measured over 0.0278 h: 10 requests/s of 500 B" in capsys.readouterr().out
    pool.write_text(POOL)  # the file's word goes first
    assert main.run([*asked, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["traffic"]["/plan"]["source"] == "pool file"


@pytest.mark.parametrize(
    "report",
    [
        {"uptime_s": 59.0},
        {"uptime_s": "nan"},
        {"services": {"/plan": {"received": 0, "answered": 0}}},
        {"services": {"/plan": {"received": 5, "answered": 5, "request_bytes": -1}}},
        {"services": {"/plan": {"received": 5, "answered": 5, "request_bytes": "x"}}},
    ],
)
def test_a_report_that_says_nothing_is_not_guessed_from(tmp_path, report):
    usual = {"pid": 1, "written_at": 0.0, "uptime_s": 100.0, "links": []}
    count = {"received": 5, "answered": 5, "request_bytes": 5, "response_bytes": 5}
    file = tmp_path / "proxy-status.json"
    file.write_text(json.dumps({**usual, "services": {"/plan": count}}))
    assert list(plans.measured(proxy_report.read(file, "0" * 16))) == ["/plan"]
    file.write_text(json.dumps({**usual, "services": {"/plan": count}, **report}))
    assert plans.measured(proxy_report.read(file, "0" * 16)) == {}


def test_losses_of_the_pool_are_shown(pool, capsys):
    """History of a pool that exists counts: a place that lost a replica shows it."""
    order = preview.order(pool)
    store = composition.make_store("planner")
    startup.write(store, order.spec, source=order.source, file=pool, cloud="local")
    place = order.launches[0].offer.placement.location
    now = time.time()
    with store.paths.history.open("a") as lines:
        for at, event in ((now - 200, "launch"), (now - 190, "ready"), (now - 60, "gone")):
            lines.write(
                json.dumps({"at": at, "kind": event, "slot": 0, "generation": 1, "location": place})
                + "\n"
            )
    assert main.run(["plan", str(pool), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    [lost] = [o for o in shown["offers"] if o["recent_losses"]]
    assert f"{lost['cloud']}/{lost['region']}/{lost['zone']}" == place
    assert lost["losses_per_hour"] > 0.25


def test_how_long_launches_took_is_shown_and_taken_for_the_time_away(pool, capsys):
    """Nine in ten of the pool's own, once there are five; before, what is assumed."""
    order = preview.order(pool)
    store = composition.make_store("planner")
    startup.write(store, order.spec, source=order.source, file=pool, cloud="local")
    now = time.time() - 1000
    for generation, took_s in enumerate((90, 100, 110, 120, 700), 1):
        for at, kind in ((now, "launch"), (now + took_s, "ready"), (now + took_s + 5, "ready")):
            line = {"at": at, "kind": kind, "slot": 0, "generation": generation}
            with store.paths.history.open("a") as lines:
                lines.write(json.dumps(line) + "\n")
        assert main.run(["plan", str(pool), "--json"]) == 0
        shown = json.loads(capsys.readouterr().out)
        known = 700 if generation == 5 else None
        assert shown["ready_p90_s"] == known
        assert shown["availability"]["assumed"]["recovery_s"] == (known or 1200)
    said = "within 700 s of the order (p90 of 5 launches; "
    assert main.run(["plan", str(pool)]) == 0
    assert f"{said}used as the recovery below)" in capsys.readouterr().out
    pool.write_text(POOL + "  availability: 0.9995\n")  # its replicas are counted by the file alone
    assert main.run(["plan", str(pool)]) == 0
    text = capsys.readouterr().out
    assert f"{said}set `recovery_s` to it)" in text
    assert "recovery 20 min" in text


@needs("matplotlib")
def test_every_offer_is_drawn_and_the_chosen_ones_named(pool, tmp_path):
    file = tmp_path / "plan.svg"
    assert main.run(["plan", str(pool), "--plot", str(file)]) == 0
    drawing = file.read_text()
    assert sorted(re.findall("<!-- (slot .*?) -->", drawing)) == ["slot 0", "slot 1"]
    assert drawing.count('style="fill-opacity: 0; stroke: #1f77b4') == 10 + 1  # the legend's


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (
            ["aws,us-west-1,a,m,8,32,0.4,-0.1,"],
            "row 2: SpotPrice: `-0.1` is not a number of at least 0",
        ),
        (["aws,us-west-1,a,m,8,32,0.4,cheap,"], "SpotPrice: `cheap` is not a number"),
        (["aws,us-west-1,a,m,8,32,0.4,0.1,yesterday"], "AsOf: `yesterday` is not a date"),
        ([], "no row of"),
        (["aws,us-west-1,a,m,2,4,0.4,0.1,"], "no row of"),
    ],
)
def test_a_bad_table_is_told(pool, tmp_path, capsys, rows, message):
    assert main.run(["plan", str(pool), "--prices", table(tmp_path, *rows), "--offline"]) == 1
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.out == ""


def test_a_table_that_is_none_is_told(pool, tmp_path, capsys):
    assert main.run(["plan", str(pool), "--prices", str(tmp_path / "no.csv")]) == 1
    assert "cannot be read" in capsys.readouterr().err
    (tmp_path / "x.csv").write_text("a,b\n1,2\n")
    assert main.run(["plan", str(pool), "--prices", str(tmp_path / "x.csv")]) == 1
    assert "has no column `InstanceType`" in capsys.readouterr().err


def test_a_region_that_does_not_exist_is_told_with_its_line(pool, capsys):
    pool.write_text(POOL.replace("use_spot: true", "use_spot: true, region: us-west-9"))
    assert main.run(["plan", str(pool)]) == 1
    err = capsys.readouterr().err
    assert "pool.yaml:3: resources.region: the local cloud has no region `us-west-9`" in err


def test_a_mistake_in_a_group_is_told_at_the_group(pool, capsys):
    pool.write_text(POOL + "  groups:\n    - {name: big, resources: {cpus: 512+}}\n")
    assert main.run(["plan", str(pool)]) == 1
    assert ":11: fogft.groups[0].resources.cpus: the local cloud has no" in capsys.readouterr().err


def test_a_target_out_of_reach_is_a_warning(pool, capsys):
    pool.write_text(POOL + "  availability: 0.99999\n  max_usd_per_hour: 0.3\n")
    assert main.run(["plan", str(pool)]) == 0
    captured = capsys.readouterr()
    assert "target 0.99999" in captured.out
    assert "cannot be met: 2 replicas are expected to reach 0.996346" in captured.err


def test_regions_that_cannot_be_measured_are_told(pool, tmp_path, capsys):
    """Without a network the plan stands all the same, on what is known."""
    pool.write_text(POOL.replace("local/us-west-1", "aws/us-west-1"))
    prices = table(tmp_path, "aws,us-west-1,a,m,8,32,0.4,0.1,", "aws,us-east-1,a,m,8,32,0.4,0.1,")
    assert main.run(["plan", str(pool), "--prices", prices]) == 0
    captured = capsys.readouterr()
    assert "measuring round trips to 2 regions" in captured.err
    assert "2 regions cannot be measured, such as `aws/us-east-1`: " in captured.err
    assert "response      11 ms" in captured.out
    assert main.run(["plan", str(pool), "--prices", prices, "--offline"]) == 0
    assert "measur" not in capsys.readouterr().err


GROUPS = """
name: planner
resources: {cpus: 8+, use_spot: true}
run: exec true
fogft:
  services:
    - {name: /plan, type: nav_msgs/srv/GetPlan}
    - {name: /map, type: nav_msgs/srv/GetMap}
  groups:
    - {name: steady, replicas: 1, resources: {cpus: 2+, use_spot: false}}
    - {name: fast, replicas: 1, resources: {cpus: 8+, use_spot: true}}
"""


def test_it_is_told_which_replicas_are_of_which_group(pool, capsys):
    """Each group on machines of its own kind; every one carries every service."""
    pool.write_text(GROUPS)
    assert main.run(["plan", str(pool)]) == 0
    out = capsys.readouterr().out
    assert "slot 0 (steady)" in out
    assert "slot 200 (fast)" in out
    assert main.run(["plan", str(pool), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)["replicas"]
    assert [(one["slot"], one["spot"]) for one in shown] == [(0, False), (200, True)]
    assert [one["services"] for one in shown] == 2 * [["/plan", "/map"]]


def test_distances_are_estimated_where_nothing_can_be_measured(pool, tmp_path, capsys):
    """Along the great circle from where the robot is; what the file says goes before."""
    place = "{robot_at: [37.87, -122.27], rtt_s: {aws/us-east-1: 0.2}}"
    pool.write_text(POOL.replace(POOL.split("placement: ")[1].strip(), place))
    regions = ("us-west-1", "us-east-1", "eu-central-1")
    prices = table(tmp_path, *(f"aws,{r},{r}a,m5.2xlarge,8,32,0.5,0.3,2026-01-01" for r in regions))
    assert main.run(["plan", str(pool), "--prices", prices, "--offline"]) == 0
    told = capsys.readouterr().out
    assert re.search(r"us-west-1a .* table, \d+ d old +\d+ ms", told)
    assert "(estimated, pool file)" in " ".join(told.split())
    assert main.run(["plan", str(pool), "--prices", prices, "--offline", "--json"]) == 0
    offers = {o["region"]: o for o in json.loads(capsys.readouterr().out)["offers"]}
    assert [offers[r]["rtt_source"] for r in regions] == ["estimated", "pool file", "estimated"]
    assert offers["us-west-1"]["rtt_s"] < 0.03 < 0.1 < offers["eu-central-1"]["rtt_s"] < 0.3


def test_a_pool_whose_services_run_tells_is_planned(pool, capsys):
    """Without `services` all replicas carry whatever `run` advertises."""
    pool.write_text(
        "name: told\nresources: {any_of: [{infra: local/us-west-1}]}\n"
        "run: exec true\nfogft: {replicas: 2}\n"
    )
    assert main.run(["plan", str(pool)]) == 0
    assert "availability  0.99" in capsys.readouterr().out
    assert main.run(["plan", str(pool), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)
