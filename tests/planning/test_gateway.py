"""The machine of a gateway that a pool launches itself: when it is bought, kept and replaced."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fogft.model.choices import ScheduleSpec, WindowSpec
from fogft.model.groups import GATEWAY_SLOT
from fogft.model.intent import Intent
from fogft.model.reason import Cause, Reason
from fogft.model.replica import Machine, MachinePhase, Observed, Offer, Placement, ReplicaId
from fogft.model.topology import LaunchedGateway
from fogft.planning.gateway import GatewayPlan, plan_gateway, resources, version
from fogft.planning.observed.history import Event, EventKind, History
from fogft.planning.sizing import Inputs
from fogft.poolfile.named_clouds import alternatives, place
from tests.planning.pool_worlds import NOW, UID, spec

POOL = spec(gateway=LaunchedGateway(launch=True))
CHEAP, DEAR = (
    Offer(Placement("aws", region, f"{region}a", "m6i.large", False), usd)
    for region, usd in (("us-east-1", 0.1), ("eu-west-1", 0.2))
)
NOTHING = Intent()
RUNS_SINCE = NOW - 1000.0


def machine(generation: int = 1, **changes) -> Machine:
    made = Machine(
        ReplicaId(UID, GATEWAY_SLOT, generation),
        CHEAP.placement,
        MachinePhase.RUNNING,
        RUNS_SINCE,
        endpoint="203.0.113.7:7448",
        usd_per_hour=0.1,
        spec_hash=version(POOL),
        set_up_at=RUNS_SINCE,
    )
    return replace(made, **changes)


def history(*events: tuple[float, EventKind, int], reason: Reason | None = None) -> History:
    return History(
        Event(at, kind, GATEWAY_SLOT, generation, "aws/us-east-1/us-east-1a", on_demand=True,
              reason=reason if kind is EventKind.FAILED else None, version=version(POOL))
        for at, kind, generation in events
    )  # fmt: skip


def step(
    *machines: Machine,
    past: History | None = None,
    intent=NOTHING,
    pool=POOL,
    heard_at=0.0,
    replicas: tuple[Machine, ...] = (),
) -> GatewayPlan:
    observed = Observed(NOW, replicas, gateway=machines)
    inputs = Inputs(pool, intent, observed, past or History())
    return plan_gateway(inputs, (CHEAP, DEAR), heard_at=heard_at)


def test_the_cheapest_is_bought_and_replicas_wait_for_its_address():
    first = step()
    assert first.launch == CHEAP
    assert first.note is not None
    assert step(machine(phase=MachinePhase.PROVISIONING, endpoint=None)).host == ""
    there = step(machine(), heard_at=NOW)
    assert (there.host, there.launch, there.ends) == ("203.0.113.7", None, ())


def test_it_costs_no_more_than_the_cap_that_holds_now_and_replicas_make_room_for_it():
    """Without it nobody reaches them. A dearer one, after a failure, has to fit, too."""
    runs = (replace(machine(), id=ReplicaId(UID, 0, 1), usd_per_hour=0.14),)
    in_vain = history((RUNS_SINCE, LAUNCHED, 1), (NOW - 21, GONE, 1))
    for cap, bought in ((0.25, DEAR), (0.15, CHEAP), (0.09, None)):
        capped = replace(POOL, max_usd_per_hour=cap)
        assert step(pool=capped, replicas=runs, past=in_vain).launch == bought
    window = WindowSpec(frozenset(range(7)), 0, 86_400, None, 0.05)
    found = step(pool=replace(POOL, schedule=ScheduleSpec("UTC", (window,))))
    assert (found.launch, found.note.limit_usd_per_hour) == (None, 0.05)


def test_its_machine_is_small_and_where_the_replicas_may_be():
    where = [{"infra": "aws/us-east-1"}, {"infra": "gcp"}]
    asked = {"accelerators": "A100", "use_spot": True, "any_of": where}
    pool = spec(task={"run": "serve", "resources": asked}, gateway=LaunchedGateway(launch=True))
    assert resources(pool) == {"any_of": where, "cpus": "2+", "use_spot": False}
    asked = {"infra": "aws/eu-west-1"}
    elsewhere = resources(replace(pool, gateway=LaunchedGateway(launch=True, resources=asked)))
    assert {place(one) for _, one in alternatives(elsewhere)} == {("aws", "eu-west-1", "")}


LAUNCHED, UP, GONE = EventKind.LAUNCH, EventKind.READY, EventKind.GONE


@pytest.mark.parametrize(
    ("past", "heard_at", "why"),
    [
        (((RUNS_SINCE, LAUNCHED, 1), (RUNS_SINCE, UP, 1)), NOW - 50, None),
        (((RUNS_SINCE, LAUNCHED, 1), (RUNS_SINCE, UP, 1)), NOW - 70, Cause.SILENT),
        (((RUNS_SINCE, LAUNCHED, 1),), 0.0, Cause.TIMEOUT),
    ],
)
def test_it_is_replaced_when_the_robot_reaches_it_no_more(past, heard_at, why):
    """After a minute, or where it never did after `start_limit_s` (900 s)."""
    ended = step(machine(), past=history(*past), heard_at=heard_at).ends
    assert [reason.cause for _, reason in ended] == ([why] if why else [])


def test_what_has_failed_or_is_outdated_ends_first():
    """Its ports may be those of its successor."""
    failed = machine(phase=MachinePhase.FAILED, failure=Reason(Cause.CAPACITY))
    for one, cause in ((failed, Cause.CAPACITY), (machine(spec_hash="old"), Cause.OUTDATED)):
        found = step(one)
        assert [reason.cause for _, reason in found.ends] == [cause]
        assert found.launch is None
    observed = Observed(NOW, (), gateway=(machine(),), certificates_due=frozenset({machine().id}))
    due = plan_gateway(Inputs(POOL, Intent(), observed, History()), (CHEAP,), heard_at=NOW)
    assert [reason.cause for _, reason in due.ends] == [Cause.CERTIFICATE_DUE]


def test_one_that_was_up_is_replaced_at_once_and_one_that_never_was_after_a_pause():
    gone = (NOW - 1, GONE, 1)
    was_up = history((RUNS_SINCE, LAUNCHED, 1), (RUNS_SINCE, UP, 1), gone)
    assert step(past=was_up).launch == CHEAP
    never = history((RUNS_SINCE, LAUNCHED, 1), gone)
    assert step(past=never).launch is None
    earlier = history((RUNS_SINCE, LAUNCHED, 1), (NOW - 21, GONE, 1))
    assert step(past=earlier).launch == DEAR, "the place may be to blame"


def test_after_two_that_never_worked_nothing_is_launched_until_the_user_says_so():
    fault = Reason(Cause.SETUP)
    kinds = (LAUNCHED, EventKind.FAILED, EventKind.ENDED)
    past = history(*((RUNS_SINCE, kind, g) for g in (1, 2) for kind in kinds), reason=fault)
    found = step(past=past)
    assert found.launch is None
    assert found.note is not None
    assert found.note.cause is Cause.NEVER_READY
    assert step(past=past, intent=Intent(retried_at=NOW - 1)).launch is not None


def test_it_counts_against_the_cap():
    """Of both: what it may cost itself, and what it leaves for replicas."""
    found = step(pool=replace(POOL, max_usd_per_hour=0.05))
    assert found.launch is None
    assert found.note is not None
    assert found.note.cause is Cause.OVER_BUDGET
    assert Observed(NOW, (), gateway=(machine(),)).below(0.5) == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("pool", "intent"), [(spec(), Intent()), (POOL, Intent(stopping=True))], ids=["file", "down"]
)
def test_it_ends_with_its_pool_or_when_the_file_no_longer_asks_for_it(pool, intent):
    found = step(machine(), pool=pool, intent=intent)
    assert [id for id, _ in found.ends] == [machine().id]
    assert found.launch is None
