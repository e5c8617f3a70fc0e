"""What every cloud promises. See `fogft.cloud.port`; to add a cloud, see `clouds`."""

from __future__ import annotations

import pytest

from fogft.errors import CloudUnreachable, NoCapacity, SpecError
from fogft.model.reason import Cause
from fogft.model.replica import MachinePhase, ReplicaId
from tests.contract.clouds import OTHER_UID, UID, CloudUnderTest, is_unreachable


def ids(made: CloudUnderTest, uid: str = UID) -> list[str]:
    return [m.id.short for m in made.cloud.machines(uid)]


def run(made: CloudUnderTest, slot: int, generation: int = 1) -> ReplicaId:
    """Launch a machine and wait until it runs."""
    order = made.order(slot, generation)
    made.cloud.launch(order)
    made.wait_until(
        lambda: [
            m
            for m in made.cloud.machines(UID)
            if m.id == order.id and m.phase is MachinePhase.RUNNING
        ]
    )
    return order.id


def test_nothing_exists_at_first(made: CloudUnderTest) -> None:
    """A new pool has no machines."""
    assert list(made.cloud.machines(UID)) == []


def test_offers_have_places_and_prices(made: CloudUnderTest) -> None:
    """There is something to buy in more than one place, and nothing is free."""
    offers = made.cloud.offers(made.resources)
    assert len({o.placement.location for o in offers}) >= 2
    assert all(o.usd_per_hour > 0 for o in offers)
    assert len({o.placement for o in offers}) == len(offers)


def test_impossible_resources_are_the_pool_files_mistake(made: CloudUnderTest) -> None:
    """What can never be met is a SpecError, not a want of capacity."""
    with pytest.raises(SpecError):
        made.cloud.offers(made.impossible)


def test_launched_machine_is_listed_at_once_as_ordered(made: CloudUnderTest) -> None:
    """When `launch` returns, the list has it: slot, generation, place, price and hash."""
    order = made.order(3, 7)
    made.cloud.launch(order)
    [machine] = made.cloud.machines(UID)
    assert machine.id == order.id
    assert machine.placement == order.placement
    assert machine.usd_per_hour == pytest.approx(order.usd_per_hour)
    assert machine.spec_hash == order.spec_hash
    assert machine.phase in (MachinePhase.PROVISIONING, MachinePhase.RUNNING)
    made.cloud.terminate(order.id)


def test_running_machine_has_an_endpoint(made: CloudUnderTest) -> None:
    """Once it runs it says where its server proxy listens."""
    id = run(made, 0)
    [machine] = made.cloud.machines(UID)
    assert machine.endpoint is not None
    host, port = machine.endpoint.rsplit(":", 1)
    assert host
    assert 0 < int(port) < 65_536
    made.cloud.terminate(id)


def test_launch_repeated_does_nothing(made: CloudUnderTest) -> None:
    """The same id twice is one machine."""
    order = made.order(0)
    made.cloud.launch(order)
    made.cloud.launch(order)
    assert ids(made) == ["0.1"]
    made.cloud.terminate(order.id)


def test_machines_are_ordered_by_id(made: CloudUnderTest) -> None:
    """Whatever the order of launches, the list is by slot and generation."""
    for slot in (2, 0, 1):
        made.cloud.launch(made.order(slot))
    assert ids(made) == ["0.1", "1.1", "2.1"]
    for slot in range(3):
        made.cloud.terminate(ReplicaId(UID, slot, 1))


def test_two_generations_of_a_slot_live_side_by_side(made: CloudUnderTest) -> None:
    """A replacement starts before the old one ends."""
    made.cloud.launch(made.order(0, 1))
    made.cloud.launch(made.order(0, 2))
    assert ids(made) == ["0.1", "0.2"]
    made.cloud.terminate(ReplicaId(UID, 0, 1))
    assert ids(made) == ["0.2"]
    made.cloud.terminate(ReplicaId(UID, 0, 2))


def test_terminated_machine_is_gone_when_the_call_returns(made: CloudUnderTest) -> None:
    """Ending is done, not begun; and can be repeated."""
    id = run(made, 0)
    made.cloud.terminate(id)
    assert ids(made) == []
    made.cloud.terminate(id)
    made.cloud.terminate(ReplicaId(UID, 9, 9))
    assert ids(made) == []


def test_machine_can_be_ended_while_it_is_provisioned(made: CloudUnderTest) -> None:
    """A launch that is no longer wanted need not finish first, and does not come back."""
    order = made.order(0)
    made.cloud.launch(order)
    made.cloud.terminate(order.id)
    run(made, 1)
    assert ids(made) == ["1.1"]
    made.cloud.terminate(ReplicaId(UID, 1, 1))


def test_pools_do_not_see_or_touch_each_other(made: CloudUnderTest) -> None:
    """A pool's list holds its own machines only; ending one leaves the other's."""
    made.cloud.launch(made.order(0))
    made.cloud.launch(made.order(0, uid=OTHER_UID))
    assert [m.id.pool_uid for m in made.cloud.machines(UID)] == [UID]
    made.cloud.terminate(ReplicaId(UID, 0, 1))
    assert ids(made, OTHER_UID) == ["0.1"]
    made.cloud.terminate(ReplicaId(OTHER_UID, 0, 1))


def test_full_location_refuses_and_launches_nothing(made: CloudUnderTest) -> None:
    """No capacity is said at once or by a FAILED machine, and another place still sells."""
    if made.fill is None:
        pytest.skip("its capacity cannot be set")
    first, second = (o.placement for o in list(made.cloud.offers(made.resources))[:2])
    made.fill(first.location)
    refused = made.order(0, at=first)
    try:
        made.cloud.launch(refused)
    except NoCapacity:
        assert ids(made) == []
    else:
        made.wait_until(
            lambda: [
                m
                for m in made.cloud.machines(UID)
                if m.failure is not None and m.failure.cause is Cause.CAPACITY
            ]
        )
        made.cloud.terminate(refused.id)
    made.cloud.launch(made.order(1, at=second))
    assert ids(made) == ["1.1"]
    made.cloud.terminate(ReplicaId(UID, 1, 1))


def test_preempted_machine_vanishes(made: CloudUnderTest) -> None:
    """Without a notice a machine is simply no longer listed."""
    if made.preempt is None:
        pytest.skip("it cannot be preempted at will")
    id = run(made, 0)
    made.preempt(id, 0.0)
    made.wait_until(lambda: ids(made) == [])


def test_notice_is_seen_before_the_machine_goes(made: CloudUnderTest) -> None:
    """Where the cloud tells of notices, the machine says so while it still runs."""
    if made.preempt is None:
        pytest.skip("it cannot be preempted at will")
    id = run(made, 0)
    assert not made.cloud.machines(UID)[0].notice
    made.preempt(id, 5.0)
    told = []

    def gone() -> bool:
        machines = made.cloud.machines(UID)
        told.extend(machine.notice for machine in machines)
        return not machines

    made.wait_until(gone)
    assert any(told) == made.notices


def test_unreachable_cloud_never_answers_with_an_empty_list(made: CloudUnderTest) -> None:
    """Cannot tell is an error in every call, and everything is as before afterwards."""
    if made.outage is None:
        pytest.skip("it cannot be made unreachable")
    id = run(made, 0)
    order = made.order(1)
    made.outage(True)
    assert is_unreachable(lambda: made.cloud.machines(UID))
    assert is_unreachable(lambda: made.cloud.terminate(id))
    with pytest.raises(CloudUnreachable):
        made.cloud.launch(order)
    made.outage(False)
    assert "0.1" in ids(made)
    for slot in range(2):
        made.cloud.terminate(ReplicaId(UID, slot, 1))
