"""The reliability arithmetic, against its laws and against the paper's own figures."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.planning.availability import replicas_needed, unavailability

seconds = st.floats(1, 1e8)
availabilities = st.floats(0.3, 1)
targets = st.floats(0.01, 0.999)


def test_the_papers_figures():
    """15 h up and 20 min recovery: 2.17 % for one VM, 0.047 % for two."""
    one = unavailability(15 * 3600, 20 * 60)
    assert one == pytest.approx(0.0217, abs=0.00005)
    assert one * one == pytest.approx(0.00047, abs=0.000005)


@pytest.mark.parametrize(("target", "count"), [(0.9995, 2), (0.9999, 3), (0.97, 1)])
def test_replicas_for_the_papers_machine(target, count):
    """Two suffice for the 0.05 % of the paper, and 99.99 % needs three."""
    assert replicas_needed(1 - unavailability(15 * 3600, 20 * 60), target) == count


@pytest.mark.parametrize(
    ("availability", "target", "count"),
    [(0.99, 0.9999, 2), (0.9, 0.999, 3), (0.9, 0.99, 2), (0.999, 0.999999, 2), (0.5, 0.875, 3)],
)
def test_round_figures_do_not_cost_a_replica_more(availability, target, count):
    """Where the target is met exactly, binary rounding must not ask for one more."""
    assert replicas_needed(availability, target) == count


@given(uptime=seconds, recovery=seconds)
def test_unavailability_is_the_share_of_recovery(uptime, recovery):
    """Down time over all time; and up and down change places with the arguments."""
    down = unavailability(uptime, recovery)
    assert 0 < down < 1
    assert down + unavailability(recovery, uptime) == pytest.approx(1)


@given(uptime=seconds, recovery=seconds, more=seconds)
def test_slower_recovery_is_never_better(uptime, recovery, more):
    """Unavailability grows with the recovery time and falls with the uptime."""
    down = unavailability(uptime, recovery)
    assert unavailability(uptime, recovery + more) >= down
    assert unavailability(uptime + more, recovery) <= down


@given(availability=availabilities, target=targets)
def test_the_count_reaches_the_target_and_one_less_does_not(availability, target):
    """The result is sufficient, and it is the smallest that is."""
    count = replicas_needed(availability, target, limit=64)
    allowed = 1 - target
    assert (1 - availability) ** count <= allowed * (1 + 1e-8)
    if count > 1:
        assert (1 - availability) ** (count - 1) > allowed


@given(availability=st.floats(0.3, 0.99), target=targets)
def test_the_count_is_the_formula_the_right_way_up(availability, target):
    """N = ceil(log P_system / log P_vm), where that ratio is not at a whole number."""
    ratio = math.log(1 - target) / math.log(1 - availability)
    if abs(ratio - round(ratio)) > 1e-6:
        assert replicas_needed(availability, target, limit=64) == math.ceil(ratio)


@given(availability=availabilities, target=targets, better=st.floats(0, 1))
def test_better_machines_never_need_more(availability, target, better):
    """A more available replica needs at most as many; a higher target at least as many."""
    higher = availability + (1 - availability) * better
    count = replicas_needed(availability, target, limit=64)
    assert replicas_needed(higher, target, limit=64) <= count
    assert replicas_needed(availability, target * (1 - better) + 0.999 * better, limit=64) >= count


def test_a_limit_too_low_is_an_error():
    with pytest.raises(ValueError, match=r"^3 replicas of 0\.5 do not reach 0\.95$"):
        replicas_needed(0.5, 0.95, limit=3)
