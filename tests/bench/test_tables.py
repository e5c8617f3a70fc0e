"""How the bench shows its results, and that each measurement can be named."""

from __future__ import annotations

import pytest

from tests.bench.__main__ import cell, measurements, shown, table


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("frozen", "frozen"),
        (1500, "1,500"),
        (0.123456, "0.123"),
        (4512.7, "4,513"),
        ({"value": 1.234, "low": 1.2, "high": 1.3}, "1.23 [1.2, 1.3]"),
    ],
)
def test_cells(value, expected):
    assert cell(value) == expected


def test_a_row_becomes_a_column_and_sizes_become_megabytes():
    rows = [
        {"way": "direct", "size_bytes": 2_500_000, "cpu": {"a": 1.0}, "all": [1]},
        {"way": "proxied", "size_bytes": 900_000, "cpu": {"a": 2.0}, "all": [2]},
    ]
    assert table(shown(rows)).splitlines() == [
        "way      direct  proxied",
        "size_mb  2.5     0.9",
        "cpu: a   1       2",
    ]


def test_there_is_a_measurement_for_each_promise():
    names = list(measurements())
    assert names == [
        "commands",
        "planning",
        "overhead-1",
        "overhead-2",
        "overhead-3",
        "rmw_zenoh",
        "throughput",
        "stalls",
        "killed",
        "hostile-junk-11",
        "hostile-crashed",
        "hostile-swallowed",
        "hostile-boasting",
        "restarted",
        "memory",
        "hours",
        "hedging",
        "load",
        "idle",
        "cancellation",
        "simulation",
        "ordering",
        "graph",
        "images",
        "bursts",
        "first",
        "lone",
        "uplink",
    ]
