"""Counting events, and which of many like ones are logged."""

from fogft.counters import worth_logging


def test_the_1st_2nd_4th_8th_and_so_on_are_logged() -> None:
    assert [count for count in range(-1, 70) if worth_logging(count)] == [1, 2, 4, 8, 16, 32, 64]
