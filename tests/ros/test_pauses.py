"""A process that was stopped notices for how long."""

from __future__ import annotations

from fogft.ros.joining import Pauses


def test_a_stop_that_dds_does_not_outlast_is_noticed_once() -> None:
    """Fast DDS gives up on a participant 20 s after the last sign of life, sent every 3 s."""
    now = [100.0]
    pauses = Pauses(lambda: now[0])

    def looked_after(seconds: float) -> bool:
        now[0] += seconds
        return pauses.was_long()

    assert [looked_after(seconds) for seconds in (0.2, 14.0, 17.0, 0.2)] == [
        False,
        False,
        True,
        False,
    ]
