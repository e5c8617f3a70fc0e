"""Every reason can be read by people, whatever its data."""

from __future__ import annotations

import pytest

from fogft.model.reason import Cause, Reason
from fogft.reason_words import words

FULL = Reason(Cause.ERROR, usd_per_hour=0.5, location="c/r/a", count=3, of=4)


@pytest.mark.parametrize("cause", Cause)
def test_every_cause_has_words(cause: Cause) -> None:
    """Made of all the data that a reason can have, without a gap or a name of the code."""
    reason = Reason(
        cause, 1, "1.2", "c/r/a", "spot", 90.0, 2, 3, 0.5, 0.9, 0.1, 0.2, "full", (FULL, FULL)
    )
    said = words(reason)
    assert said
    assert not set(said) & set("{}_") or "max_" in said
    assert "None" not in said


@pytest.mark.parametrize(
    ("reason", "said"),
    [
        (None, ""),
        (Reason(Cause.NOTICE), "preemption notice"),
        (
            Reason(Cause.UPDATING, count=1, of=3),
            "update in progress: 1 of 3 replicas are up to date",
        ),
        (Reason(Cause.CAPACITY), "capacity"),
        (Reason(Cause.SETUP, words="exit 3\nno {x}"), "setup: exit 3\nno {x}"),
        (
            Reason(Cause.TIMEOUT, because=(Reason(Cause.NOT_READY, seconds=600.0),)),
            "timeout: not ready after 600 s",
        ),
        (
            Reason(
                Cause.REPLACES,
                replica="1.2",
                because=(Reason(Cause.SILENT, seconds=8.2), Reason(Cause.FAILED_LONGEST_AGO)),
            ),
            "replaces 1.2: silent for 8 s; all locations are backing off, this one the longest",
        ),
        (
            Reason(
                Cause.ALL_BACKING_OFF, because=(Reason(Cause.QUOTA, location="aws/us-west-2/a"),)
            ),
            "every location is backing off after failures (`aws/us-west-2/a`: quota)",
        ),
        (Reason(Cause.RUN_ENDS, count=4, words="exit 1"), "`run` exited 4 times (exit 1)"),
        (Reason(Cause.ENDS_SOON, seconds=300.0), "the pool shuts down in 5 min (`max_hours`)"),
        (
            Reason(Cause.CLOCK_SET, seconds=-3600.0, because=(Reason(Cause.SLEPT, seconds=60.0),)),
            "the clock was set back by 3600 s and this machine slept for 60 s",
        ),
    ],
)
def test_how_reasons_read(reason: Reason | None, said: str) -> None:
    assert words(reason) == said
