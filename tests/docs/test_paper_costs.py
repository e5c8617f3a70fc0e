"""docs/paper-costs.md holds what `fogft plan` makes of the dated price table."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from fogft.pool.commands.plan import plan_file

ROOT = Path(__file__).parents[2]
TABLE = ROOT / "fogft" / "cloud" / "table" / "paper.csv"
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in (ROOT / "docs" / "paper-costs.md").read_text().splitlines()
    if line.startswith(("| YOLO", "| SAM", "| MPT"))
]
# As printed in the paper's table of costs: one on demand, two on demand, two spot.
PRINTED = {
    "YOLO, Pick-Scan-Place": (0.40, 0.80, 0.34),
    "SAM": (0.53, 1.06, 0.44),
    "MPT-Home, MPT-Cubicles": (1.79, 3.58, 1.69),
    "MPT-TwistyCool": (3.58, 7.16, 1.68),
    "MPT-Home, larger machines allowed": (1.79, 3.58, 1.69),
}


def cost(tmp_path: Path, asks: str, replicas: int, *, spot: bool) -> float:
    """Return what the plan of a pool costs an hour."""
    file = tmp_path / "pool.yaml"
    file.write_text(
        f"run: exec true\nresources: {{{asks}, use_spot: {str(spot).lower()}}}\n"
        "fogft:\n  services: [{name: /plan, type: nav_msgs/srv/GetPlan}]\n"
        f"  replicas: {replicas}\n"
    )
    shown = plan_file(file, prices=TABLE, offline=True)
    assert len(shown.explanation.replicas) == replicas
    return shown.explanation.cost.usd_per_hour


def test_the_page_has_every_row():
    assert {row[0] for row in ROWS} == set(PRINTED)


@pytest.mark.parametrize("row", ROWS, ids=[row[0] for row in ROWS])
def test_a_row_is_reproduced_and_each_difference_marked(row, tmp_path):
    """Ours is what the plan says; where it differs from the paper's there is a note."""
    asks = row[1].strip("`")
    plans = [(1, False), (2, False), (2, True)]
    for cell, printed, (replicas, spot) in zip(row[2:], PRINTED[row[0]], plans, strict=True):
        theirs, ours, note = re.fullmatch(r"([\d.]+) / ([\d.]+)(?: \(([abcd])\))?", cell).groups()
        assert float(theirs) == printed
        assert cost(tmp_path, asks, replicas, spot=spot) == pytest.approx(float(ours), abs=0.0051)
        assert (abs(float(ours) - float(theirs)) > 0.005) == (note is not None)


def test_two_replicas_are_in_the_papers_two_regions(tmp_path):
    cost(tmp_path, "cpus: 32", 2, spot=True)
    shown = plan_file(tmp_path / "pool.yaml", prices=TABLE, offline=True)
    assert {r.offer.placement.region for r in shown.explanation.replicas} == {
        "us-west-1",
        "us-west-2",
    }
