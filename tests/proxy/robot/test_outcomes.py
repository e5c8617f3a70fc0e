"""What is held against a replica's service, and what only against its load, link or start."""

from __future__ import annotations

import pytest

from fogft.metrics.outcomes import Outcomes
from fogft.model.refusal import Refusal

REPLICA = 1


@pytest.mark.parametrize(
    ("reason", "held"),
    [
        (Refusal.CRASHED, 1),
        (Refusal.MALFORMED, 1),
        (Refusal.NOT_READY, 0),
        (Refusal.OVERLOADED, 0),
        (Refusal.LOST, 0),
        (Refusal.CANCELLED, 0),
    ],
)
def test_only_what_its_service_did_is_held_against_a_replica(reason, held):
    """A replica that still starts, is full or cut off says nothing about its version."""
    outcomes = Outcomes()
    outcomes.refusal(reason, REPLICA)
    assert outcomes.of[REPLICA].ill == held
    assert outcomes.refused == {reason: 1}


def test_a_refusal_of_no_request_is_counted_and_held_against_nobody():
    outcomes = Outcomes()
    outcomes.refusal(Refusal.CRASHED)
    assert outcomes.refused == {Refusal.CRASHED: 1}
    assert not outcomes.of


def test_of_replicas_that_are_gone_the_latest_are_remembered():
    outcomes = Outcomes()
    for replica in range(5000):
        outcomes.won(replica, 0.1, 1)
        outcomes.keep({0, replica})
    assert 100 <= len(outcomes.report()["won"]) <= 102
    assert outcomes.of[0].won == 1
    assert outcomes.count["answered"] == 5000
