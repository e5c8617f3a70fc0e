"""``fogft cost``: what pools have cost, also those that have ended."""

from __future__ import annotations

import json
from pathlib import Path

from fogft.cli import main
from tests.pool.folder.test_costs import NOON, STEADY, UID, CostBook, machine


def test_what_was_spent_is_shown_by_day_and_replica(home: Path, capsys):
    for name, price in (("perception", 0.5), ("planner", 0.25)):
        kept = CostBook(home / "costs", name, UID)
        kept.look(NOON + 18 * 3600, [machine(0, STEADY, usd_per_hour=price)], [], 600.0)
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
