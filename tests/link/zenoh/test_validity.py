"""Whose clock is wrong, in words."""

from __future__ import annotations

import datetime

from hypothesis import given
from hypothesis import strategies as st

from fogft.link.zenoh.diagnosis import judged_here, judged_there

DAY = 86_400.0
NOW = datetime.datetime(2026, 11, 21, 12, 0, tzinfo=datetime.timezone.utc).timestamp()


def test_a_certificate_of_yesterday_names_both_clocks() -> None:
    said = judged_here(NOW - DAY, NOW)
    assert "it expired at 2026-11-20 12:00 UTC" in said
    assert "this machine's clock says 2026-11-21 12:00 UTC" in said


def test_a_good_certificate_that_is_refused_over_there_is_their_clocks_fault() -> None:
    said = judged_there(NOW + DAY, NOW)
    assert said.startswith("the replica's clock is wrong")


@given(st.integers(-9, 9))
def test_our_own_certificates_end_is_our_own_fault(days: int) -> None:
    """The replica's clock is blamed exactly when by ours it is still valid."""
    ends = NOW + days * DAY
    blamed = judged_there(ends, NOW).startswith("the replica's clock")
    assert blamed == (days > 0)
