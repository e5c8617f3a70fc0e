"""The policy of docs/how-to/clouds.md is enough, and nothing that is missing in it goes unnoticed.

Runs inside a world (`world.sh`), whose AWS enforces that policy. Replicas are launched under it
without each of its permissions, one after the other: what needs one names it. Then one is launched
and ended under exactly it. Prints a table of steps; ends with status 1 at the first thing wrong.
"""

from __future__ import annotations

import logging
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from fogft.cloud.port import Launch
from fogft.cloud.sky.adapter import SkyCloud
from fogft.errors import CloudError
from fogft.model.reason import Cause
from fogft.model.replica import Machine, MachinePhase, ReplicaId
from tests.sky.emulated_aws.emulation import Steps, control, running, until
from tests.sky.emulated_aws.policy import PAGE, actions, statements
from tests.sky.emulated_aws.prove_adapter import FILES, TASK, UID
from tests.sky.emulated_aws.under_contract import RESOURCES, adapter, stub_server

step = Steps()
# What a launch can do without: each has a step of its own.
OTHERWISE = {
    *("servicequotas:GetServiceQuota", "iam:ListAttachedRolePolicies"),
    *("iam:ListRolePolicies", "iam:GetRolePolicy"),
    *("ec2:Describe*", "ec2:TerminateInstances", "ec2:DeleteSecurityGroup"),
    *("ec2:ModifyInstanceAttribute", "ec2:StopInstances", "ec2:StartInstances"),
}


class Log(logging.Handler):
    """What the manager's log would have."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []
        logging.getLogger("fogft").addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


def order_of(cloud: SkyCloud, slot: int, *, use_spot: bool = True) -> Launch:
    offer = cloud.offers({**RESOURCES, "use_spot": use_spot})[0]
    id, price = ReplicaId(UID, slot, 1), offer.usd_per_hour
    return Launch(id, "proof", offer.placement, price, "abcd", TASK, FILES)


def outcome(cloud: SkyCloud, order: Launch) -> Machine:
    """Launch a replica, or start one that is stopped; return what became of it."""
    (cloud.start if order.is_there else cloud.launch)(order)
    id = order.id

    def ended() -> Machine | None:
        found = next(m for m in cloud.machines(UID) if m.id == id)
        return found if found.phase is not MachinePhase.PROVISIONING else None

    machine = until(f"{id.short} has come to something", ended)
    assert isinstance(machine, Machine)
    return machine


def names(machine: Machine, action: str) -> None:
    """See to it that a launch has failed for the want of a permission, and says of which."""
    failure = machine.failure
    assert failure is not None, machine
    print(f"        {failure.cause.value}: {failure.words}", flush=True)
    assert failure.cause is Cause.CREDENTIALS, failure
    assert action.split(":")[1].rstrip("*") in failure.words, failure


def main() -> int:
    log = Log()
    stub_server()
    cloud = adapter(Path.home() / "policy")
    with step("credentials are good"):
        assert cloud.check(["aws"]) == {"aws": ""}
    listed = actions(statements(PAGE.read_text()))
    control("/deny?action=ec2:Describe*")
    with step("without ec2:Describe* `up` says that it cannot tell, and names what it asked for"):
        assert "not authorized to perform: ec2:Describe" in cloud.unverified("aws")
    control("/deny?action=servicequotas:GetServiceQuota")
    with step("without servicequotas:GetServiceQuota `plan` says that quotas cannot be read"):
        cloud.offers(RESOURCES)
        (told,) = cloud.left_out()
        print(f"        {told}", flush=True)
        assert "not authorized to perform: servicequotas:GetServiceQuota" in told
    for action in ("iam:ListAttachedRolePolicies", "iam:ListRolePolicies", "iam:GetRolePolicy"):
        control(f"/deny?action={action}")
        with step(f"without {action} `up` says that the role cannot be read"):
            told = " ".join(cloud.exposures(["aws"], open_port=None))
            assert f"not authorized to perform: {action}" in told, told
    control("/deny")
    tried = [one for one in listed if one not in OTHERWISE]
    for slot, action in enumerate(tried):
        control(f"/deny?action={action}")
        with step(f"a launch without {action} fails and names it"):
            machine = outcome(cloud, order_of(cloud, slot))
            names(machine, action)
        control("/deny")
        cloud.terminate(machine.id)
    assert running() == []
    with step("under the whole policy a replica runs"):
        machine = outcome(cloud, order_of(cloud, 50))
        assert machine.phase is MachinePhase.RUNNING, machine.failure
    control("/deny?action=ec2:TerminateInstances")
    with step("without ec2:TerminateInstances its end is not believed, and the reason is told"):
        with pytest.raises(CloudError, match="TerminateInstances") as refused:
            cloud.terminate(machine.id)
        print(f"        {refused.value.message}", flush=True)
        assert len(running()) == 1
    control("/deny?action=ec2:ModifyInstanceAttribute")
    with step("... and with it it ends, though SkyPilot may not do what it does before"):
        cloud.terminate(machine.id)
        assert running() == []
    with step("... and on demand one runs, of which the log says that its guard only stops it"):
        order = order_of(cloud, 51, use_spot=False)
        machine = outcome(cloud, order)
        assert machine.phase is MachinePhase.RUNNING, machine.failure
        assert any("ModifyInstanceAttribute" in line for line in log.lines)
    control("/deny?action=ec2:StopInstances")
    with step("without ec2:StopInstances it is not stopped, and the reason is told"):
        with pytest.raises(CloudError, match="StopInstances") as refused:
            cloud.stop(order)
        print(f"        {refused.value.message}", flush=True)
        assert len(running()) == 1
    control("/deny?action=ec2:StartInstances")
    with step("... and with it it is, but without ec2:StartInstances does not start again"):
        cloud.stop(order)
        assert running() == []
        names(outcome(cloud, replace(order, is_there=True)), "ec2:StartInstances")
    control("/deny")
    cloud.terminate(order.id)
    with step("under the whole policy, another one runs"):
        machine = outcome(cloud, order_of(cloud, 52))
        assert machine.phase is MachinePhase.RUNNING, machine.failure
    control("/deny?action=ec2:DeleteSecurityGroup")
    with step("without ec2:DeleteSecurityGroup the machine ends, and what may be left is told"):
        with pytest.raises(CloudError, match="DeleteSecurityGroup") as refused:
            cloud.terminate(machine.id)
        print(f"        {refused.value.message}", flush=True)
        assert running() == []
    control("/deny")
    with step("... and with it nothing is left to end"):
        cloud.terminate(machine.id)
        assert not cloud.machines(UID)
    denied = {one["action"] for one in control("/log", post=False) if one["event"] == "denied"}
    print(f"        asked for in vain: {', '.join(sorted(denied))}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
