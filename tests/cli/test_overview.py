"""All pools at a glance, and what has happened to one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from fogft.cli import main
from fogft.model.plain import to_plain
from fogft.model.reason import Cause, Reason
from fogft.planning.observed.history import Event, EventKind
from tests.fakes.pools import FILE, STATUS, alive, lay_down
from tests.pool.folder.test_costs import NOON, STEADY, UID, CostBook, machine, seen

LAUNCH = Event(1_000_000.0, EventKind.LAUNCH, 0, 1, "local/us-west-2/a", Reason(Cause.NEW_SLOT))
GONE = Event(1_000_060.0, EventKind.GONE, 0, 1, reason=Reason(Cause.NOTICE))


def test_each_pool_has_a_row_with_what_is_known_now(home, capsys, monkeypatch):
    """One that answers, one whose processes died, and one whose status is damaged."""
    monkeypatch.delenv("COLUMNS")
    paths = lay_down(home)
    lay_down(home, replace(STATUS, pool="detector"), age_s=78)
    broken = lay_down(home, replace(STATUS, pool="broken"))
    broken.status.write_text("{")
    with alive(paths):
        assert main.run(["list"]) == 0
        header, first, second, third = capsys.readouterr().out.splitlines()[:4]
        assert main.run(["list", "--json"]) == 0
        found = {one["pool"]: one for one in json.loads(capsys.readouterr().out)}
    assert header.split() == ["POOL", "ANSWERS", "READY", "CLOUD", "$/H", "SEEN", "FILE"]
    assert first.split()[:2] == ["broken", "?"]
    assert second.split() == ["detector", "no", "?", "of", "3", "local", "?", "78", "s", FILE]
    assert third.split()[:7] == ["planner", "yes", "1", "of", "3", "local", "0.063"]
    assert (found["planner"]["answers"], found["detector"]["answers"]) == (True, False)
    assert "is damaged" in found["broken"]["error"]


@pytest.mark.parametrize("status", [STATUS, None])
def test_what_an_exported_pool_has_left_here_is_shown(home, capsys, status):
    """Its client proxy may still answer; only `down` makes sense here."""
    paths = lay_down(home, status)
    paths.identity.rename(paths.exported)
    assert main.run(["list"]) == 0
    said = capsys.readouterr().out
    assert "exported" in said
    assert main.run(["status"]) == (0 if status else 1)
    said = capsys.readouterr().err
    assert "`fogft down planner` removes what is" in said
    assert "fogft up" not in said
    assert main.run(["down"]) == 0
    assert not paths.folder.exists()


def test_where_there_is_none_that_is_said(capsys):
    assert main.run(["list"]) == 0
    assert "no pools on this machine" in capsys.readouterr().err


def test_events_say_what_when_where_and_why(home, capsys):
    """A loss is told with the place of its launch, and with its reason."""
    paths = lay_down(home)
    paths.history.write_text("".join(json.dumps(to_plain(one)) + "\n" for one in (LAUNCH, GONE)))
    assert main.run(["events", "planner"]) == 0
    header, launched, gone = capsys.readouterr().out.splitlines()
    assert header.split() == ["TIME", "EVENT", "REPLICA", "LOCATION", "WHY"]
    assert launched.split(maxsplit=4)[2:] == [
        "launched",
        "0.1",
        "local/us-west-2/a  fills a new slot",
    ]
    assert gone.split(maxsplit=4)[2:] == ["gone", "0.1", "local/us-west-2/a  preemption notice"]
    assert main.run(["events", "-n", "1", "--json"]) == 0
    (told,) = json.loads(capsys.readouterr().out)
    assert (told["event"], told["reason"]) == ("gone", {"cause": "preemption_notice"})


@pytest.mark.parametrize("words", [["status"], ["logs"], ["events"]])
def test_a_pool_is_named_in_the_same_ways_everywhere(home, capsys, words):
    """By its name alone, or by `--pool`, as for every other command."""
    for name in ("planner", "detector"):
        lay_down(home, replace(STATUS, pool=name))
    assert main.run(words) == 1
    assert main.run([*words, "planner"]) == 0
    assert main.run([*words, "--pool", "planner"]) == 0
    assert main.run([*words, "no-such"]) == 1
    assert "error: there is no pool `no-such`" in capsys.readouterr().err
    assert main.run([*words, "planner", "--pool", "detector"]) == 1
    assert "two pools are named, `planner` and `--pool detector`" in capsys.readouterr().err


def test_what_was_spent_is_shown_by_day_and_replica(home: Path, capsys):
    for name, price in (("perception", 0.5), ("planner", 0.25)):
        kept = CostBook(home / "costs", name, UID)
        machines = [machine(0, STEADY, usd_per_hour=price)]
        kept.look(seen(NOON + 18 * 3600, machines, []), 600.0)
    assert main.run(["cost", "perception"]) == 0
    shown = capsys.readouterr().out
    assert "perception: $9.000" in shown
    assert "planner" not in shown
    assert [line.split()[-2:] for line in shown.splitlines()[1:3]] == [
        ["12.00", "6.000"],
        ["6.00", "3.000"],
    ]
    assert main.run(["cost", "--json"]) == 0
    first, second = json.loads(capsys.readouterr().out)
    assert (first["usd"], second["usd"]) == (9.0, 4.5)
    assert [day["usd"] for day in first["days"]] == [6.0, 3.0]
    assert first["days"][0]["replicas"][0]["instance"] == "m6i.large"


def test_a_pool_of_which_nothing_is_known_is_an_error(home: Path, capsys):
    assert main.run(["cost"]) == 0
    assert main.run(["cost", "nobody"]) == 1
    assert "no costs are recorded" in capsys.readouterr().err
