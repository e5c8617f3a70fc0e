"""The bound of one who knows the future: no policy that keeps all ready costs less."""

from __future__ import annotations

import itertools
import random

import pytest

from fogft.simulation.bound import least_usd_per_hour
from fogft.simulation.timeline import Timeline, of_changes
from tests.simulation.trials import Trial, run

HOUR = 3600.0


def bound(lines, *, spot=0.3, on_demand: float | None = 1.0, replicas=1, boot_s=360.0, hours=10):
    prices = dict.fromkeys(lines, spot)
    return least_usd_per_hour(
        lines, prices, on_demand, replicas, boot_s=boot_s, length_s=hours * HOUR
    )


def line(*changes: tuple[float, int], hours=10) -> Timeline:
    return of_changes([(at * HOUR, n) for at, n in changes], hours * HOUR)


def test_one_zone_with_room_costs_its_price_and_one_boot():
    assert bound({"a": line((0, 9))}, replicas=2) == pytest.approx(2 * 0.3 * 10.1 / 10)


def test_while_a_zone_is_gone_on_demand_serves_and_all_boots_are_paid():
    found = bound({"a": line((0, 9), (4, 0), (6, 9))})
    on_demand_s, spot_s = 2.1 + 0.1, 7.9 + 0.2  # it returns a boot after the zone
    assert found == pytest.approx((on_demand_s * 1.0 + spot_s * 0.3) / 10)


def test_room_for_one_serves_one_only():
    found = bound({"a": line((0, 1))}, replicas=2)
    assert found == pytest.approx((0.3 + 1.0) * 10.1 / 10)


def test_without_on_demand_and_without_room_it_cannot_be():
    assert bound({"a": line((0, 9), (4, 0), (6, 9))}, on_demand=None) is None


@pytest.mark.parametrize("seed", range(20))
def test_it_is_what_trying_all_schedules_gives(seed):
    """Two zones and on demand, one replica, in steps of an hour, with a boot of an hour."""
    chance = random.Random(seed)
    room = [[chance.random() < 0.6 for _ in range(7)] for _ in "ab"]
    lines = {
        zone: of_changes([(at * HOUR, int(up)) for at, up in enumerate(ups)], 7 * HOUR)
        for zone, ups in zip("ab", room, strict=True)
    }
    prices = [0.3, 0.4, 1.0]

    def usd(states) -> float:
        total, before = 0.0, None
        for at, state in enumerate(states):
            if state < 2 and not room[state][at]:
                return float("inf")
            if state != before:
                if state < 2 and at and not room[state][at - 1]:
                    return float("inf")
                total += prices[state]
            total += prices[state]
            before = state
        return total

    best = min(map(usd, itertools.product(range(3), repeat=7))) / 7
    found = least_usd_per_hour(lines, {"a": 0.3, "b": 0.4}, 1.0, 1, boot_s=HOUR, length_s=7 * HOUR)
    assert found == pytest.approx(best)


def test_no_policy_that_keeps_all_ready_costs_less():
    bound, ours = (run(Trial("cpu", policy, days=3)) for policy in ("omniscient", "fogft"))
    assert bound.available == 1.0
    assert bound.usd_per_hour <= ours.usd_per_hour
