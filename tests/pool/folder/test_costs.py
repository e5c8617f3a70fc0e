"""What machines have cost, by replica and day."""

from __future__ import annotations

from pathlib import Path

import pytest

from fogft.model.reason import Cause, Reason
from fogft.model.replica import Machine, MachinePhase, Observed, Offer, Placement, ReplicaId
from fogft.pool.folder.costs import DAY_S, CostBook, path_of, read_all

SPOT = Placement("aws", "us-east-1", "us-east-1a", "m6i.large")
STEADY = Placement("aws", "us-east-1", "us-east-1a", "m6i.large", spot=False)
NOON = 20_000 * DAY_S + DAY_S / 2
UID = "00000000000000aa"


def machine(slot: int = 0, place: Placement = SPOT, **changes: object) -> Machine:
    fields: dict[str, object] = {"launched_at": NOON, "usd_per_hour": 0.1} | changes
    return Machine(ReplicaId(UID, slot, 1), place, MachinePhase.RUNNING, **fields)  # type: ignore[arg-type]


def seen(now: float, machines: list[Machine], offers: list[Offer]) -> Observed:
    return Observed(now, tuple(machines), offers=tuple(offers))


def book(folder: Path) -> CostBook:
    return CostBook(folder, "perception", UID)


def test_each_day_and_replica_is_charged_at_the_price_of_its_time(tmp_path: Path):
    """A spot machine at the market's price, one on demand at its own; a night is two days."""
    kept = book(tmp_path)
    both = [machine(0), machine(1, STEADY, usd_per_hour=0.5)]
    for hour in range(25):
        price = 0.1 if hour <= 2 else 0.2
        kept.look(seen(NOON + 3600 * hour, both, [Offer(SPOT, price, "live")]), 600.0)
    kept.look(seen(NOON + 24 * 3600 + 1, both[:1], []), 600.0)
    [costs] = read_all(tmp_path)
    spent = {(one.day[-2:], one.replica): (one.hours, one.usd) for one in costs.spent}
    assert {key: round(hours) for key, (hours, _) in spent.items()} == dict.fromkeys(spent, 12)
    first, second = sorted({day for day, _ in spent})
    assert spent[first, "0.1"][1] == pytest.approx(2 * 0.1 + 10 * 0.2)
    assert spent[second, "0.1"][1] == pytest.approx(12 * 0.2, abs=1e-3)
    assert spent[first, "1.1"][1] == pytest.approx(12 * 0.5)
    assert costs.usd == pytest.approx(kept.usd)


def test_what_went_while_no_manager_looked_is_charged_as_long_as_it_can_have_run(tmp_path: Path):
    book(tmp_path).look(seen(NOON + 3600, [machine(0), machine(1)], []), 600.0)
    later = book(tmp_path)
    assert later.usd == pytest.approx(0.2)
    later.look(seen(NOON + 5 * 3600, [machine(0)], []), 1800.0)
    assert later.usd == pytest.approx(0.2 + 4 * 0.1 + 0.5 * 0.1)


def test_what_was_refused_costs_nothing(tmp_path: Path):
    kept = book(tmp_path)
    kept.look(seen(NOON + 30, [machine(0)], []), 600.0)
    assert kept.usd > 0
    refused = machine(0, failure=Reason(Cause.CAPACITY, words="full"))
    kept.look(seen(NOON + 60, [refused], []), 600.0)
    assert kept.usd == 0
    broken = machine(0, failure=Reason(Cause.SETUP, words="setup failed"))
    kept.look(seen(NOON + 3660, [broken], []), 600.0)
    assert kept.usd > 0.1


def test_a_machine_that_has_run_has_cost_something_though_its_restart_is_refused(tmp_path: Path):
    kept = book(tmp_path)
    kept.look(seen(NOON + 3600, [machine(0, STEADY)], []), 600.0)
    full = Reason(Cause.CAPACITY, words="full")
    again = machine(0, STEADY, launched_at=NOON + 3630, failure=full)
    kept.look(seen(NOON + 3660, [again], []), 600.0)
    assert kept.usd == pytest.approx(0.1)


def test_a_price_that_is_no_number_is_not_charged(tmp_path: Path):
    kept = book(tmp_path)
    kept.look(seen(NOON + 3600, [machine(0)], [Offer(SPOT, float("nan"), "live")]), 600.0)
    assert kept.usd == pytest.approx(0.1)


def test_a_clock_that_goes_back_charges_nothing_twice(tmp_path: Path):
    kept = book(tmp_path)
    kept.look(seen(NOON + 3600, [machine(0)], []), 600.0)
    kept.look(seen(NOON + 60, [machine(0)], []), 600.0)
    kept.look(seen(NOON + 120, [machine(0)], []), 600.0)
    assert kept.usd == pytest.approx(0.1 + 60 / 3600 * 0.1)


def test_a_damaged_file_is_begun_anew_and_old_days_become_one_sum(tmp_path: Path):
    path = path_of(tmp_path, "perception", UID)
    path.write_text("{")
    kept = book(tmp_path)
    kept.look(seen(NOON + 3600, [machine(0)], []), 600.0)
    kept.look(seen(NOON + 500 * DAY_S, [], []), 0.0)
    [costs] = read_all(tmp_path)
    assert (costs.spent, costs.before_usd) == ((), pytest.approx(0.1))


@pytest.mark.parametrize("set_s", [50 * 365 * DAY_S, -365 * DAY_S])
def test_a_clock_that_is_set_is_no_time_in_which_machines_ran(tmp_path: Path, set_s: float):
    """A robot whose clock has no battery boots in 1970, until it hears the time."""
    kept = book(tmp_path)
    kept.look(seen(NOON + 3600, [machine(0), machine(1)], []), 600.0)
    kept.look(seen(NOON + 7200 + set_s, [machine(0)], []), 600.0, set_s)
    assert kept.usd == pytest.approx(0.3 + 600 / 3600 * 0.1)
    kept.look(seen(NOON + 10_800 + set_s, [machine(0)], []), 600.0, set_s)
    assert kept.usd == pytest.approx(0.4 + 600 / 3600 * 0.1)


def test_no_machine_is_charged_for_time_before_its_launch(tmp_path: Path):
    """The last manager's clock was slow, in 1970, and was not set while it ran."""
    book(tmp_path).look(seen(60.0, [machine(0)], []), 600.0)
    kept = book(tmp_path)
    kept.look(seen(NOON + 3600, [machine(0)], []), 600.0)
    assert kept.usd == pytest.approx(0.1)
