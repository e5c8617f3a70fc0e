"""What `fogft chaos` does to machines and locations of the local cloud."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fogft.cloud.local import chaos, faults, processes
from fogft.errors import CloudError, NoCapacity
from fogft.model.replica import MachinePhase, ReplicaId
from tests.fakes.waiting import wait_for

CHECKOUT = Path(__file__).parents[2]


class Caller:
    """A client of the stand-in, over the machine's relay."""

    def __init__(self, endpoint: str) -> None:
        host, port = endpoint.split(":")
        self.socket = socket.create_connection((host, int(port)), timeout=30)

    def echo(self, within_s: float = 30.0) -> bool:
        """Whether a byte comes back in time. One that is late counts for the next call."""
        self.socket.settimeout(within_s)
        self.socket.sendall(b"\x16")  # as TLS begins, or it is not passed on
        try:
            return self.socket.recv(1) == b"\x16"
        except TimeoutError:
            return False

    def ended(self) -> bool:
        """Whether the connection is broken by now."""
        self.socket.settimeout(30)
        try:
            return not self.socket.recv(1)
        except ConnectionResetError:
            return True


@pytest.fixture
def call():
    made: list[Caller] = []

    def make(endpoint: str) -> Caller:
        made.append(Caller(endpoint))
        assert made[-1].echo()
        return made[-1]

    yield make
    for caller in made:
        caller.socket.close()


# -- one machine


def test_a_preempted_machine_has_a_notice_then_is_gone(local):
    machine = local.running()
    local.chaos.preempt(machine.id, notice_s=60.0)
    assert local.machine(machine.id).notice
    notice = json.loads((local.folder(machine.id) / "notice.json").read_text())
    assert notice["action"] == "terminate"
    assert abs(notice["at"] - time.time() - 60) < 30
    local.chaos.preempt(machine.id, notice_s=0.0)
    local.wait_gone(machine.id)
    assert "reason='preempted'" in Path(local.cloud.log(machine.id)).read_text()


def test_the_notice_lasts_as_the_zone_says_and_is_never_put_off(local):
    (local.root / "regions.yaml").write_text("boot_s: 0.01\nnotice_s: 70\n")
    id = local.running().id
    assert 60 < local.chaos.preempt(id) <= 70
    assert local.chaos.preempt(id, notice_s=1000) <= 70
    assert local.chaos.preempt(id, notice_s=30) <= 30


def test_a_frozen_machine_is_taken_away_when_its_notice_is_over(local):
    """It cannot see that its time has come; who lists the machines does."""
    id = local.running().id
    local.chaos.freeze(id)
    local.chaos.preempt(id, notice_s=0.0)
    local.wait_gone(id)


def test_a_machine_is_preempted_while_it_boots(local):
    id = local.launch(where="slow-1/a")
    wait_for(lambda: local.machine(id).progress == "booting")
    local.chaos.preempt(id, notice_s=0.0)
    local.wait_gone(id)


def test_a_killed_machine_is_gone_at_once(local, call):
    machine = local.running()
    caller = call(machine.endpoint)
    local.chaos.kill(machine.id)
    assert local.machine(machine.id) is None
    assert processes.find(machine=str(machine.id)) == []
    assert caller.ended()


def test_freeze_stops_every_process_and_thaw_lets_them_go_on(local, call):
    machine = local.running(spawn=["exec setsid sleep 3600"])
    caller = call(machine.endpoint)
    local.given(machine.id)
    wait_for(lambda: len(processes.find(machine=str(machine.id))) == 4)
    assert local.chaos.freeze(machine.id) == 4
    assert all(map(processes.stopped, processes.find(machine=str(machine.id))))
    assert not caller.echo(within_s=0.2)
    assert local.machine(machine.id).phase is MachinePhase.RUNNING, "the cloud sees no fault"
    assert local.chaos.thaw(machine.id) > 0
    assert local.chaos.thaw(machine.id) == 0, "nothing is frozen any more"
    assert caller.echo()
    assert not any(map(processes.stopped, processes.find(machine=str(machine.id))))


def test_a_frozen_machine_can_be_terminated(local):
    id = local.running().id
    local.chaos.freeze(id)
    local.cloud.terminate(id)
    assert processes.find(machine=str(id)) == []


def test_a_slow_link_delays_each_way_until_cleared(local, call):
    machine = local.running()
    caller = call(machine.endpoint)
    local.chaos.slow(machine.id, delay_s=0.3)
    wait_for(lambda: not caller.echo(within_s=0.2))
    assert caller.echo(), "it does come, later"
    local.chaos.clear()
    fresh = call(machine.endpoint)
    wait_for(lambda: fresh.echo(within_s=0.2))


def test_a_blackhole_ends_by_itself_though_its_author_is_gone(local, call):
    machine = local.running()
    caller = call(machine.endpoint)
    code = (
        "import sys; from pathlib import Path; from fogft.model.replica import ReplicaId\n"
        "from fogft.cloud.local.chaos import Chaos\n"
        "Chaos(Path(sys.argv[1])).blackhole(ReplicaId(sys.argv[2], 0, 1), for_s=6)"
    )
    subprocess.run(
        [sys.executable, "-c", code, str(local.root), local.uid], cwd=CHECKOUT, check=True
    )
    wait_for(lambda: not caller.echo(within_s=0.1))
    assert caller.echo(), "it was not broken, and goes on"


def test_faults_of_one_machine_leave_the_others_alone(local, call):
    first, second = local.running(0), local.running(1)
    caller = call(second.endpoint)
    local.chaos.freeze(first.id)
    local.chaos.blackhole(first.id)
    assert caller.echo()
    local.chaos.clear()
    assert call(first.endpoint).echo()


def test_a_link_file_that_is_damaged_is_ignored(local, call):
    machine = local.running()
    caller = call(machine.endpoint)
    (local.folder(machine.id) / "link.json").write_text('{"delay_s": "much"}')
    log = Path(local.cloud.log(machine.id))
    wait_for(lambda: "link_file_ignored" in log.read_text())
    assert caller.echo()


def test_what_is_not_there_cannot_be_hurt(local):
    gone = local.running().id
    local.cloud.terminate(gone)
    for action in ("preempt", "kill", "freeze", "thaw", "slow", "blackhole"):
        for id in (gone, ReplicaId(local.uid, 5, 1)):
            with pytest.raises(CloudError, match="has no machine") as error:
                getattr(local.chaos, action)(id)
            assert error.value.hint, action


# -- locations


def test_an_outage_cuts_off_then_ends_all_machines_there_and_refuses_new_ones(local, monkeypatch):
    monkeypatch.setattr(chaos, "OUTAGE_KILL_AFTER_S", 5.0)
    hit = local.running(0, where="us-west-1/a").id
    booting = local.launch(1, where="slow-1/a")
    spared = local.running(2, where="us-west-2/a").id
    assert local.chaos.outage("us-west-1") == [hit]
    assert local.chaos.outage("local/slow-1/a") == [booting]
    with pytest.raises(NoCapacity, match="outage in `local/us-west-1`"):
        local.launch(3, where="us-west-1/b")
    assert faults.read_link(local.folder(hit) / "link.json").blackhole
    local.wait_gone(hit)
    local.wait_gone(booting)
    assert local.machine(spared) is not None
    local.chaos.clear()
    local.running(3, where="us-west-1/b")


def test_an_outage_ends_by_itself(local):
    local.chaos.outage("us-west-1", for_s=0.3)

    def launched() -> bool:
        try:
            local.launch()
        except NoCapacity:
            return False
        return True

    assert wait_for(launched)


def test_capacity_can_be_set_for_a_zone_and_a_region(local):
    local.launch(0)
    local.chaos.capacity("local/us-west-1/a", 1)
    with pytest.raises(NoCapacity, match="1 of 1 machines in `local/us-west-1/a`"):
        local.launch(1)
    local.launch(1, where="us-west-1/b")
    local.chaos.capacity("us-west-1", 2)
    local.chaos.capacity("us-west-1/a", 9)
    with pytest.raises(NoCapacity, match="2 of 2 machines in `local/us-west-1`"):
        local.launch(2)
    assert len(local.cloud.machines(local.uid)) == 2, "those that run stay"
    local.chaos.clear()
    local.launch(2)


@pytest.mark.parametrize("location", ["mars", "local/us-west-9", "us-west-1/z", "aws/us-west-1"])
def test_a_location_that_does_not_exist_is_told(local, location):
    with pytest.raises(CloudError, match="no location") as error:
        local.chaos.outage(location)
    assert error.value.hint
    assert faults.read_cloud(local.root) == faults.CloudFaults()


def test_machines_of_all_pools_share_a_location(local):
    local.launch(0, where="us-west-2/a")
    local.launch(1, where="us-west-2/a")
    other = "f" * 8 + local.uid[:8]
    order = local.order(0, where="us-west-2/a")
    foreign = type(order)(**{**vars(order), "id": ReplicaId(other, 0, 1)})
    with pytest.raises(NoCapacity):
        local.cloud.launch(foreign)


def test_a_process_that_a_machine_forks_while_it_is_frozen_is_frozen_as_well(local, tmp_path):
    """Freezing looks again until nothing new runs."""
    beat = tmp_path / "beat"
    loop = f"while true; do (date +%s%N > {beat}); done"
    id = local.running(spawn=[loop]).id
    wait_for(beat.exists)
    local.chaos.freeze(id)
    frozen = processes.find(machine=str(id))
    assert len(frozen) >= 4
    assert all(map(processes.stopped, frozen))
    local.cloud.terminate(id)


def test_what_is_forked_as_the_last_one_stops_is_frozen_as_well(local, monkeypatch):
    """It runs on, though all that were found before have stopped."""
    id, sent, found = local.running().id, [], iter([[1], [1, 2], [1, 2]])
    with monkeypatch.context() as seen:
        seen.setattr(processes, "find", lambda **_: next(found))
        seen.setattr(processes, "stopped", lambda pid: True)
        seen.setattr(processes, "send", lambda pids, number: sent.append(pids))
        assert local.chaos.freeze(id) == 2
    assert sent == [[1], [1, 2]]
