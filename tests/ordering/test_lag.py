"""A replica that falls behind is restored: at once, then ever more seldom, up to a limit."""

from __future__ import annotations

import itertools

from fogft.ordering.peer import LAG_LIMIT, RESTORE_FIRST_S, RESTORE_LONGEST_S, Lag


def restores(behind: int, seconds: float) -> list[float]:
    """Return when one that is always so far behind is restored."""
    one = Lag()
    return [at / 10 for at in range(int(seconds * 10)) if one.too_far(behind, at / 10)]


def test_one_that_keeps_up_is_left_alone():
    assert restores(LAG_LIMIT, 60) == []


def test_one_that_never_keeps_up_is_restored_ever_more_seldom():
    times = restores(LAG_LIMIT + 1, 120)
    gaps = [after - before for before, after in itertools.pairwise(times)]
    assert times[0] == 0.0
    assert gaps[0] == RESTORE_FIRST_S
    assert gaps == sorted(gaps)
    assert gaps[-1] == RESTORE_LONGEST_S


def test_one_that_kept_up_for_long_is_restored_soon_again():
    one = Lag()
    at = 0.0
    for _ in range(5):
        while not one.too_far(LAG_LIMIT + 1, at):
            at += 0.1
    assert not one.too_far(0, at + 2 * RESTORE_LONGEST_S + 0.1)
    assert one.too_far(LAG_LIMIT + 1, at + 2 * RESTORE_LONGEST_S + 0.2)
    assert not one.too_far(LAG_LIMIT + 1, at + 2 * RESTORE_LONGEST_S + 0.3)
    assert one.too_far(LAG_LIMIT + 1, at + 2 * RESTORE_LONGEST_S + 0.2 + RESTORE_FIRST_S)
