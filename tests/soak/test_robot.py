"""The report of a soak of the robot's side: whose loss is whose, and what fails it."""

from __future__ import annotations

import pytest

from tests.soak.robot import DAMAGES, MAY_LOSE_S, Time, faults_found, show, table

TIMES = [Time("kill proxy", 10.0, 14.0, [12.0]), Time("full disk", 20.0, 25.0)]
GOOD = [[at / 2, at / 2 + 0.1, True] for at in range(60)]


def lost(at: float) -> list[object]:
    return [at, None, False]


def test_requests_are_counted_by_the_fault_that_there_was():
    rows = table(TIMES, [end for end in GOOD if end[0] != 11.0] + [lost(11.0)])
    assert {kind: len(row.took) + len(row.lost) for kind, row in rows.items()} == {
        "none": 40,
        "kill proxy": 9,
        "full disk": 11,
    }
    assert rows["kill proxy"].lost == [1.0]
    assert rows["kill proxy"].gap_s == pytest.approx(1.0)
    assert rows["full disk"].gap_s == pytest.approx(0.5)
    assert (rows["kill proxy"].whole_s, rows["full disk"].whole_s) == (4.0, 5.0)


@pytest.mark.parametrize(
    ("end", "why"),
    [
        (lost(10.4), []),
        (lost(9.2), []),  # a killed proxy had taken it
        (lost(12.4), []),
        (lost(11.9), []),
        (lost(12.6), ["kill proxy: 1 lost, asked so many s after it struck: 0.60"]),
        (lost(10.6), ["kill proxy: 1 lost, asked so many s after it struck: 0.60"]),
        (lost(22.0), ["full disk: 1 lost, asked so many s after it struck: 2.00"]),
        (lost(17.0), ["none: 1 lost, asked so many s after it struck: 0.00"]),
        ([12.2, 12.3, False], ["kill proxy: 1 wrong"]),
    ],
)
def test_only_what_a_killed_proxy_costs_may_be_lost(end, why):
    kinds = ("kill proxy", "full disk")
    assert faults_found(table(TIMES, [*GOOD, end]), kinds, "") == why


def test_a_fault_in_which_nothing_was_answered_has_its_line(capsys):
    show(table(TIMES, [*GOOD[:20], lost(22.0)]), 7)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "robot's side, seed 7: 21 requests, 1 lost"
    assert lines[-1].split()[:5] == ["full", "disk", "1", "1", "1"]


def test_what_was_never_done_and_what_never_became_whole_fail_it():
    found = faults_found(table(TIMES, GOOD), ("kill proxy", "suspend"), "not whole")
    assert found == ["not whole", "never done: suspend"]


def test_every_fault_that_may_cost_something_is_one_of_the_faults():
    assert set(MAY_LOSE_S) < set(DAMAGES)
