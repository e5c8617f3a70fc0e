"""What the adapter does when everything works, and when each part of the cloud does not."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from fogft.cloud.sky import adapter, naming
from fogft.cloud.sky.following import ASK_LIMIT_S, JOB_PAUSE_S, LAUNCH_LIMIT_S
from fogft.cloud.sky.naming import cluster_name
from fogft.cloud.sky.sdk import ClusterState, JobState, RefusedError
from fogft.cloud.sky.wheel import Locks
from fogft.errors import (
    CloudError,
    CloudUnreachable,
    NoCapacity,
    QuotaExceeded,
    SpecError,
    StateError,
)
from fogft.model.names import SETUP_LIMIT_S
from fogft.model.reason import Cause, Reason
from fogft.model.replica import MachinePhase, Placement
from tests.fakes.sky import EAST, WEST, ScriptedProvider, ScriptedSky, replica
from tests.sky.scene import Scene

ID = replica()
NAME = naming.cluster_name(ID)
LOOKED_AT = int(JOB_PAUSE_S) + 10
"""Rounds until a job was asked about."""


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path)


# -- the good path --------------------------------------------------------------------------


def test_a_launch_is_listed_at_once_and_becomes_a_running_machine(scene: Scene):
    scene.cloud.launch(scene.order())
    assert scene.machine().phase is MachinePhase.PROVISIONING
    scene.sky.boot(NAME)
    scene.work()
    assert scene.machine().progress == "launching"
    scene.sky.finish(NAME, JobState.SETTING_UP)
    scene.work()
    assert scene.machine().progress == "setting up"
    assert scene.machine().phase is MachinePhase.RUNNING, "the machine runs, whatever runs on it"
    scene.sky.jobs[NAME] = JobState.RUNNING
    scene.work()
    machine = scene.machine()
    assert (machine.phase, machine.progress) == (MachinePhase.RUNNING, "")
    assert machine.endpoint is not None
    assert machine.endpoint.endswith(":7448")
    assert (machine.usd_per_hour, machine.spec_hash, machine.placement) == (0.021, "abcd", EAST)


def test_a_launch_that_no_thread_could_follow_is_followed_later(scene: Scene, monkeypatch):
    def none(step: Callable[[], bool]) -> None:
        raise OSError("can't start new thread")

    with monkeypatch.context() as full:
        full.setattr(scene.cloud, "repeat", none)
        scene.cloud.launch(scene.order())
        scene.machines()
    scene.sky.finish(NAME)
    scene.machines()
    scene.work()
    assert scene.machine(replica()).phase.value == "running"


def test_repeating_a_launch_does_nothing(scene: Scene):
    scene.cloud.launch(scene.order())
    scene.cloud.launch(scene.order())
    assert scene.sky.asked("launch") == [NAME]


def test_terminate_leaves_nothing_in_any_list_and_can_be_repeated(scene: Scene):
    scene.launched()
    scene.cloud.terminate(ID)
    scene.cloud.terminate(ID)
    assert not scene.machines()
    assert not scene.sky.records
    assert not scene.provider.found
    assert not scene.cloud.journal.files(ID).exists()


def test_a_machine_is_stopped_for_the_price_of_its_disk_and_started_under_its_id(scene: Scene):
    on_demand = replace(EAST, spot=False)
    order = scene.order(place=on_demand)
    scene.launched(place=on_demand)
    scene.cloud.stop(order)
    stopped = scene.machine()
    assert (stopped.phase, stopped.failure) == (MachinePhase.STOPPED, None)
    assert stopped.usd_per_hour == pytest.approx(64 * 0.08 / 730)
    scene.work(60)
    assert scene.machine().phase is MachinePhase.STOPPED, "nobody takes it for a failure"
    scene.cloud.launch(replace(order, files={"replica.yaml": b"newer"}, is_there=True))
    assert scene.machine().phase is MachinePhase.PROVISIONING
    scene.sky.finish(NAME)
    scene.work()
    running = scene.machine()
    assert (running.phase, running.usd_per_hour) == (MachinePhase.RUNNING, 0.021)
    assert scene.sky.asked("launch") == [NAME, NAME]
    assert (scene.cloud.journal.files(ID) / "replica.yaml").read_bytes() == b"newer"
    scene.cloud.stop(order)
    scene.cloud.terminate(ID)
    assert not scene.machines()
    assert not scene.provider.found


@pytest.mark.parametrize(("spot", "told"), [(False, ["i-2"]), (True, [])])
def test_a_machine_on_demand_is_to_end_when_its_guard_shuts_it_down(
    scene: Scene, spot: bool, told: list[str]
):
    """As soon as it exists: a spot machine does so anyway, this one would stop, and cost on."""
    scene.cloud.launch(scene.order(place=replace(EAST, spot=spot)))
    scene.sky.boot(NAME)
    scene.work()
    assert scene.provider.end_when_down == told


def test_a_gateways_machine_opens_its_ports_too(scene: Scene):
    """A replica's opens the link's alone."""
    scene.cloud.launch(scene.order(more_ports=(7470, 7471, 7472)))
    assert scene.sky.task(NAME)["resources"]["ports"] == ["7448", "7470", "7471", "7472"]
    scene.cloud.launch(scene.order(replica(1)))
    assert scene.sky.task(cluster_name(replica(1)))["resources"]["ports"] == ["7448"]
    pod = Placement("runpod", "CA", "CA-MTL-1", "cpu3c-2-8", spot=False)
    with pytest.raises(CloudError, match="maps ports"):
        scene.cloud.launch(scene.order(replica(2), pod, more_ports=(7470,)))


def test_a_stopped_machine_that_is_gone_is_listed_no_more(scene: Scene):
    scene.launched()
    scene.cloud.stop(scene.order())
    scene.sky.preempt(NAME)
    del scene.sky.records[NAME]
    scene.cloud.audit()
    assert not scene.machines()


def test_a_pool_sees_its_own_machines_only(scene: Scene):
    other = replica(uid="00000000000000bb")
    scene.cloud.launch(scene.order(other))
    scene.launched()
    assert [m.id for m in scene.machines()] == [ID]


def test_clusters_of_others_are_never_named_to_skypilot(scene: Scene):
    """Every call that changes something is about a name that one of our ids makes."""
    scene.launched()
    for name in ("dev", "fogft", "fogft-00000000000000aa", "fogft-00000000000000aa-x-1"):
        scene.sky.records[name] = scene.sky.records[NAME].__class__(name, ClusterState.UP)
    scene.machines()
    scene.cloud.terminate(ID)
    changed = [s for call in ("down", "launch") for s in scene.sky.asked(call)]
    assert set(changed) == {NAME}
    assert len(scene.sky.records) == 4


def test_the_list_of_clusters_is_asked_once_in_five_seconds(scene: Scene):
    scene.launched()
    before = len(scene.sky.asked("clusters"))
    for _ in range(5):
        scene.machines()
    assert len(scene.sky.asked("clusters")) - before <= 1


def test_nobody_waits_for_a_list_that_is_a_little_old(scene: Scene):
    """A loss must not wait behind SkyPilot: it is read on another thread, and soon awaited."""
    scene.launched()
    scene.machines()
    scene.pass_s(10)
    scene.sky.unreachable = True
    before = len(scene.sky.asked("clusters"))
    assert len(scene.machines()) == len(scene.machines()) == 1
    assert len(scene.sky.asked("clusters")) == before, "not on the thread that asked"
    scene.work(rounds=1)
    assert len(scene.sky.asked("clusters")) == before + 1
    scene.pass_s(10)
    with pytest.raises(CloudUnreachable):
        scene.machines()


# -- refused, failed and hanging launches -----------------------------------------------------


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("InsufficientInstanceCapacity: no Spot capacity", NoCapacity),
        ("MaxSpotInstanceCountExceeded: Max spot instance count exceeded", QuotaExceeded),
        ("something else", CloudError),
    ],
)
def test_a_launch_that_is_refused_at_once_leaves_no_trace(scene: Scene, text: str, error: type):
    scene.sky.fail_next("launch", RefusedError("ValueError", [text]))
    with pytest.raises(error):
        scene.cloud.launch(scene.order())
    assert not scene.machines()
    assert not scene.cloud.journal.files(ID).exists()


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("InsufficientInstanceCapacity", "capacity"),
        ("VcpuLimitExceeded: You have requested more vCPU", "quota"),
        ("RequestExpired: Request has expired", "credentials"),
        ("boom", "error"),
    ],
)
def test_a_launch_that_fails_is_listed_with_its_cause_until_it_is_terminated(
    scene: Scene, text: str, cause: str
):
    kind = "ResourcesUnavailableError" if cause != "error" else "RuntimeError"
    scene.cloud.launch(scene.order())
    scene.sky.fail(NAME, kind, "Failed to acquire resources", text)
    scene.work()
    machine = scene.machine()
    assert machine.phase is MachinePhase.FAILED
    assert (machine.failure.cause, text in machine.failure.words) == (Cause(cause), True)
    scene.cloud.terminate(ID)
    assert not scene.machines()


def test_a_launch_that_fails_after_the_vm_was_made_leaves_no_vm(scene: Scene):
    """Nobody has to notice first: the machine is taken down as soon as the failure is known."""
    scene.cloud.launch(scene.order())
    scene.sky.boot(NAME)
    scene.sky.finish(NAME)  # SkyPilot may even call it UP
    scene.sky.fail(NAME, "CommandError", "Command failed with return code 1")
    scene.work()
    assert scene.machine().phase is MachinePhase.FAILED
    assert not scene.provider.found


def test_a_failed_launch_whose_end_skypilot_refuses_is_ended_by_the_provider_and_stays_listed(
    scene: Scene,
):
    scene.cloud.launch(scene.order())
    scene.sky.boot(NAME)
    scene.sky.down_fails = 99
    scene.sky.fail(NAME, "RuntimeError", "ray did not start")
    scene.work()
    assert not scene.provider.found
    assert scene.machine().phase is MachinePhase.FAILED
    scene.sky.down_fails = 0
    scene.cloud.terminate(ID)
    assert not scene.machines()


def test_a_launch_that_hangs_is_aborted_and_taken_down(scene: Scene):
    scene.cloud.launch(scene.order())
    scene.sky.boot(NAME)
    scene.work()
    scene.pass_s(LAUNCH_LIMIT_S)
    scene.work()
    machine = scene.machine()
    assert machine.failure.cause is Cause.TIMEOUT
    assert machine.failure.words.startswith("still launching after 900 s")
    assert f"provisioning {NAME}" in machine.failure.words
    assert scene.sky.asked("cancel")
    assert not scene.provider.found


def test_a_launch_that_queues_behind_others_has_its_whole_time_when_it_begins(scene: Scene):
    """A local API server on two cores launches two at a time; a third may wait for minutes."""
    scene.cloud.launch(scene.order())
    scene.sky.queue(NAME)
    for _ in range(2):
        scene.work()
        scene.pass_s(LAUNCH_LIMIT_S)
    scene.cloud = scene.another_process()
    assert scene.machine().failure is None
    scene.sky.queue(NAME, waits=False)
    scene.work()
    scene.pass_s(LAUNCH_LIMIT_S - 60)
    scene.work()
    assert scene.machine().failure is None
    scene.pass_s(100)
    scene.work()
    assert scene.machine().failure.words.startswith("still launching after 900 s")


def test_one_that_no_worker_ever_takes_is_given_up(scene: Scene):
    scene.cloud.launch(scene.order())
    scene.sky.queue(NAME)
    scene.work()
    scene.pass_s(SETUP_LIMIT_S)
    scene.work()
    assert scene.machine().failure.words.startswith("still queued after 3600 s")


def test_a_failed_setup_shows_the_end_of_its_log_and_ends_the_vm(scene: Scene):
    scene.cloud.launch(scene.order())
    scene.sky.job_logs[NAME] = "collecting\nERROR: no such package: yolo\n"
    scene.sky.finish(NAME, JobState.SETUP_FAILED)
    scene.work(LOOKED_AT)
    machine = scene.machine()
    assert machine.failure.cause is Cause.SETUP
    assert "no such package: yolo" in machine.failure.words
    assert not scene.provider.found


def test_a_server_proxy_that_ends_at_once_is_a_failure_with_its_log(scene: Scene):
    scene.cloud.launch(scene.order())
    scene.sky.job_logs[NAME] = "error: `replica.yaml`: key 'run' is missing\n"
    scene.sky.finish(NAME, JobState.ENDED)
    scene.work(LOOKED_AT)
    assert "key 'run' is missing" in scene.machine().failure.words


def test_a_job_is_asked_about_seldom(scene: Scene):
    """Each question is expensive: none before `setup` can have ended, and none after it has."""
    scene.cloud.launch(scene.order())
    scene.sky.finish(NAME, JobState.SETTING_UP)
    scene.work(int(JOB_PAUSE_S))
    assert not scene.sky.asked("job")
    scene.work(int(4 * JOB_PAUSE_S))
    assert 3 <= len(scene.sky.asked("job")) <= 5
    scene.sky.jobs[NAME] = JobState.RUNNING
    scene.work(LOOKED_AT)
    asked = len(scene.sky.asked("job"))
    scene.work(LOOKED_AT)
    assert len(scene.sky.asked("job")) == asked


def test_a_setup_that_hangs_ends_at_its_own_limit(scene: Scene):
    scene.cloud.launch(scene.order())
    scene.sky.finish(NAME, JobState.SETTING_UP)
    scene.work()
    scene.pass_s(LAUNCH_LIMIT_S)
    scene.work()
    assert scene.machine().phase is MachinePhase.RUNNING
    scene.pass_s(SETUP_LIMIT_S)
    scene.work()
    assert scene.machine().failure.cause is Cause.TIMEOUT
    assert not scene.provider.found


def test_what_cannot_be_honoured_is_refused_before_anything_is_written(scene: Scene):
    with pytest.raises(SpecError, match=r"resources\.ports"):
        scene.cloud.launch(scene.order(task={"resources": {"ports": 8080}}))
    assert not scene.machines()
    assert not scene.sky.calls or "launch" not in dict(scene.sky.calls)


# -- preemption -------------------------------------------------------------------------------


@pytest.mark.parametrize("provider", [True, False])
def test_a_preempted_machine_is_gone_after_a_refresh_of_it_alone(tmp_path: Path, provider: bool):
    """The provider's word counts at once; without it SkyPilot refreshes one record."""
    scene = Scene(tmp_path, with_provider=provider)
    scene.launched(replica(0))
    scene.launched(replica(1), WEST)
    scene.sky.preempt(NAME)
    scene.pass_s(60)
    assert len(scene.machines()) == 2, "SkyPilot's memory is not the cloud"
    before = len(scene.sky.asked("refresh"))
    scene.cloud.refresh(ID)
    assert [m.id for m in scene.machines()] == [replica(1)]
    scene.work()
    assert scene.sky.asked("refresh")[before:] == [NAME]
    assert NAME not in scene.sky.records, "the dead record is cleaned up"
    assert [m.id for m in scene.machines()] == [replica(1)]


@pytest.mark.parametrize("age_s", [0, 60])
def test_a_machine_that_the_provider_still_lists_is_left_alone(scene: Scene, age_s: int):
    scene.launched()
    scene.pass_s(age_s)
    scene.cloud.refresh(ID)
    assert scene.machine().phase is MachinePhase.RUNNING
    assert not scene.sky.asked("refresh")


def test_a_machine_that_the_provider_lists_as_stopped_is_asked_about_at_skypilot(scene: Scene):
    """So GCP lists what it has preempted."""
    scene.launched()
    scene.pass_s(120)
    for key, one in scene.provider.found.items():
        scene.provider.found[key] = replace(one, running=False)
    scene.sky.records[NAME] = replace(scene.sky.records[NAME], state=ClusterState.STOPPED)
    scene.cloud.refresh(ID)
    assert scene.sky.asked("refresh") == [NAME]
    assert scene.machine().phase is MachinePhase.FAILED


@pytest.mark.parametrize("ended_by_us", [False, True])
def test_a_provider_of_another_account_is_not_believed(tmp_path: Path, ended_by_us: bool):
    """An API server elsewhere has credentials of its own; those here may be of another account."""
    scene = Scene(tmp_path)
    scene.sky = ScriptedSky(ScriptedProvider())
    scene.cloud = scene.another_process()
    scene.launched()
    scene.pass_s(120)
    scene.cloud.refresh(ID)
    scene.work()
    assert scene.machine().phase is MachinePhase.RUNNING
    if ended_by_us:
        scene.sky.down_lies = True
        with pytest.raises(CloudUnreachable):
            scene.cloud.terminate(ID)
    else:
        scene.sky.preempt(NAME)
        scene.cloud.refresh(ID)
        assert not scene.machines()


def test_a_machine_that_the_provider_does_not_list_yet_is_asked_about_at_skypilot(scene: Scene):
    """A provider's list may miss a machine in its first seconds."""
    scene.cloud.launch(scene.order())
    scene.provider.found.clear()
    scene.cloud.refresh(ID)
    assert scene.sky.asked("refresh") == [NAME]
    assert scene.machine().phase is MachinePhase.PROVISIONING


def test_a_provider_that_may_not_be_asked_leaves_the_refresh_to_skypilot(scene: Scene):
    scene.launched()
    scene.sky.preempt(NAME)
    scene.provider.allowed = False
    scene.pass_s(60)
    scene.cloud.refresh(ID)
    assert scene.sky.asked("refresh") == [NAME]
    assert not scene.machines()


def test_a_stopped_machine_has_failed(scene: Scene):
    scene.launched()
    record = scene.sky.records[NAME]
    scene.sky.records[NAME] = type(record)(NAME, ClusterState.STOPPED, EAST)
    scene.pass_s(20)
    assert scene.machine().phase is MachinePhase.FAILED


def test_a_running_replica_that_skypilot_no_longer_understands_is_left_to_its_link(scene: Scene):
    """Its health comes from the data path: INIT alone ends nothing that answers."""
    scene.launched()
    record = scene.sky.records[NAME]
    scene.sky.records[NAME] = type(record)(NAME, ClusterState.INIT, EAST, "10.0.0.9")
    scene.pass_s(20)
    assert scene.machine().phase is MachinePhase.RUNNING


# -- cannot tell is not gone -------------------------------------------------------------------


def test_credentials_that_expire_while_running_take_nothing_away(scene: Scene):
    scene.launched()
    scene.pass_s(20)
    scene.sky.fail_next("clusters", CloudUnreachable("ExpiredToken"))
    with pytest.raises(CloudUnreachable):
        scene.machines()
    scene.pass_s(60)
    scene.provider.reachable = False
    with pytest.raises(CloudUnreachable):
        scene.cloud.refresh(ID)
    assert scene.machine().phase is MachinePhase.RUNNING


def test_a_server_that_dies_during_a_launch_only_delays_it(scene: Scene):
    scene.cloud.launch(scene.order())
    scene.sky.fail_next("request", CloudUnreachable("connection refused"), times=3)
    scene.work()
    assert scene.machine().phase is MachinePhase.PROVISIONING
    scene.sky.finish(NAME)
    scene.work()
    assert scene.machine().phase is MachinePhase.RUNNING


def test_a_server_that_forgot_a_launch_is_asked_for_the_machine(scene: Scene):
    scene.cloud.launch(scene.order())
    scene.sky.boot(NAME)
    record = scene.sky.records[NAME]
    scene.sky.forget_everything()
    scene.work()
    assert scene.machine().failure == Reason(Cause.ERROR, words="SkyPilot lost this launch")
    assert not scene.provider.found, "the provider was asked to end what SkyPilot forgot"
    assert record.name == NAME


def test_an_order_of_unknown_fate_is_listed_and_found_again(scene: Scene):
    """The connection broke after SkyPilot had heard: the launch is adopted, not repeated."""
    scene.sky.fail_next("launch-heard", CloudUnreachable("connection reset"))
    with pytest.raises(CloudUnreachable):
        scene.cloud.launch(scene.order())
    assert scene.machine().phase is MachinePhase.PROVISIONING
    scene.sky.finish(NAME)
    scene.work()
    assert scene.machine().phase is MachinePhase.RUNNING


def test_an_order_that_was_never_heard_fails_after_a_while(scene: Scene):
    scene.sky.fail_next("launch", CloudUnreachable("connection refused"))
    with pytest.raises(CloudUnreachable):
        scene.cloud.launch(scene.order())
    scene.work()
    assert scene.machine().phase is MachinePhase.PROVISIONING
    scene.pass_s(ASK_LIMIT_S)
    scene.work()
    assert scene.machine().failure == Reason(
        Cause.ERROR, words="SkyPilot has no record of this launch"
    )


def test_down_that_a_cloud_does_not_answer_says_what_may_still_run(scene: Scene):
    scene.launched()
    scene.sky.fail_next("down", CloudUnreachable("timed out"), times=5)
    with pytest.raises(CloudUnreachable) as caught:
        scene.cloud.terminate(ID)
    assert NAME in caught.value.message
    assert f"sky down {NAME}" in caught.value.hint
    assert scene.machine().phase is MachinePhase.FAILED, "it stays listed, so it is tried again"


def test_down_that_claims_success_is_not_believed(tmp_path: Path):
    scene = Scene(tmp_path, with_provider=False)
    scene.launched()
    scene.sky.down_lies = True
    with pytest.raises(CloudUnreachable, match="still there"):
        scene.cloud.terminate(ID)
    scene.sky.down_lies = False
    scene.cloud.terminate(ID)
    assert not scene.machines()


def test_an_end_is_looked_at_where_the_answer_is_surest(scene: Scene, tmp_path: Path):
    """The provider's own list, where it may be asked; else a refresh of SkyPilot's."""
    scene.launched()
    scene.cloud.terminate(ID)
    assert scene.sky.asked("refresh") == []
    scene.launched(replica(1))
    scene.provider.allowed = False
    scene.cloud.terminate(replica(1))
    assert scene.sky.asked("refresh") == [cluster_name(replica(1))]
    alone = Scene(tmp_path / "alone", with_provider=False)
    alone.launched()
    alone.cloud.terminate(ID)
    assert alone.sky.asked("refresh") == [NAME]


# -- what SkyPilot has forgotten ---------------------------------------------------------------


def test_down_that_only_forgets_is_finished_with_the_provider(scene: Scene):
    scene.launched()
    scene.sky.down_forgets = True
    key = next(iter(scene.provider.found))
    scene.cloud.terminate(ID)
    assert scene.provider.terminated == [key]
    assert not scene.provider.found


def test_a_lost_database_of_skypilot_loses_no_machine(scene: Scene):
    scene.launched()
    endpoint = scene.machine().endpoint
    scene.sky.forget_everything()
    scene.pass_s(20)
    machine = scene.machine()
    assert machine.phase is MachinePhase.RUNNING
    assert machine.endpoint == endpoint
    scene.cloud.terminate(ID)
    assert not scene.provider.found


def test_one_that_skypilots_list_misses_once_is_listed_with_the_next(tmp_path: Path):
    """Where the provider cannot be asked, nobody else knows of it."""
    scene = Scene(tmp_path, with_provider=False)
    scene.launched()
    records = dict(scene.sky.records)
    scene.pass_s(60)
    scene.sky.records.clear()
    assert not scene.machines()
    scene.sky.records.update(records)
    scene.pass_s(60)
    scene.machines()  # begins to renew the list
    scene.work()
    assert [m.id for m in scene.machines()] == [ID]


def test_a_provider_that_does_not_answer_leaves_a_missing_machine_unknown(scene: Scene):
    scene.launched()
    scene.sky.forget_everything()
    scene.pass_s(20)
    scene.provider.reachable = False
    with pytest.raises(CloudUnreachable):
        scene.machines()


def test_without_a_right_to_ask_the_provider_skypilots_word_has_to_do(scene: Scene):
    scene.launched()
    scene.provider.allowed = False
    scene.sky.forget_everything()
    scene.pass_s(20)
    assert not scene.machines()
    assert "no permission to list" in scene.cloud.unverified("aws")
    assert "gcp" in scene.cloud.unverified("gcp")


def test_a_machine_that_only_the_provider_knows_is_found_and_can_be_ended(scene: Scene):
    scene.launched()
    scene.sky.forget_everything()
    scene.cloud.journal.close(ID)  # and our own notes are lost too
    scene.pass_s(60)
    scene.machines()  # begins a census
    scene.work()
    machine = scene.machine()
    assert machine.phase is MachinePhase.FAILED
    assert machine.usd_per_hour == 0.021
    scene.cloud.terminate(ID)
    assert not scene.provider.found
    assert not scene.machines()


def test_without_our_notes_skypilots_labels_tell_the_same(scene: Scene):
    scene.launched()
    before = scene.machine()
    scene.cloud.journal.close(ID)
    after = scene.machine()
    assert (after.phase, after.endpoint, after.spec_hash, after.usd_per_hour) == (
        before.phase,
        before.endpoint,
        before.spec_hash,
        before.usd_per_hour,
    )


def test_an_audit_finds_machines_of_every_pool_of_this_user_and_of_nobody_else(scene: Scene):
    mine, lost = replica(uid="00000000000000bb"), replica(uid="00000000000000cc")
    for id in (mine, lost):
        scene.cloud.launch(scene.order(id))
        scene.sky.boot(naming.cluster_name(id))
    theirs = replica(uid="00000000000000dd")
    scene.cloud.launch(scene.order(theirs))
    name = naming.cluster_name(theirs)
    scene.sky.boot(name)
    record = scene.sky.records.pop(name)
    for id in (lost, theirs):
        scene.cloud.journal.close(id)
    for key, instance in list(scene.provider.found.items()):
        if instance.id == theirs:
            labels = {**record.labels, naming.OWNER: "bob_laptop"}
            scene.provider.found[key] = type(instance)(theirs, key, instance.placement, labels)
    audit = scene.cloud.audit()
    assert [m.id for m in audit.machines] == [mine, lost]
    assert audit.asked == {"aws"}


def test_an_audit_of_a_pool_asks_the_provider_now_and_not_from_memory(scene: Scene):
    """What SkyPilot and our notes have both lost is found, a second after it was lost."""
    scene.launched()
    scene.machines()
    scene.sky.forget_everything()
    scene.cloud.journal.close(ID)
    scene.pass_s(20)
    assert not scene.machines()
    assert [m.id for m in scene.cloud.audit(ID.pool_uid).machines] == [ID]
    assert scene.provider.asked_regions[-1] is None, "everywhere, not where it should be"
    assert not scene.cloud.audit("00000000000000ff").machines


def test_an_audit_says_which_clouds_it_could_ask(scene: Scene):
    scene.provider.allowed = False
    assert scene.cloud.audit(ID.pool_uid).asked == frozenset()
    scene.provider.allowed = True
    assert scene.cloud.audit(ID.pool_uid).asked == {"aws"}
    scene.provider.reachable = False
    with pytest.raises(CloudUnreachable):
        scene.cloud.audit(ID.pool_uid)


def test_whether_a_cloud_can_be_asked_is_found_out_by_asking(scene: Scene):
    """`up` says so before anything was launched: nobody has refused us by then."""
    assert scene.cloud.unverified("aws") == ""
    scene.provider.allowed = False
    assert "fogft relies on SkyPilot's list" in scene.cloud.unverified("aws")
    scene.provider.allowed = True
    scene.provider.reachable = False
    assert "ExpiredToken" in scene.cloud.unverified("aws")


# -- a manager that dies -----------------------------------------------------------------------


@pytest.mark.parametrize("stage", ["asked", "booted", "finished", "failed", "setting up"])
def test_another_process_takes_a_launch_over_at_any_stage(scene: Scene, stage: str):
    """No orphan and no duplicate: the successor lists one machine, and it comes to its end."""
    scene.cloud.launch(scene.order())
    if stage == "booted":
        scene.sky.boot(NAME)
    elif stage == "finished":
        scene.sky.finish(NAME)
    elif stage == "failed":
        scene.sky.fail(NAME, "ResourcesUnavailableError", "InsufficientInstanceCapacity")
    elif stage == "setting up":
        scene.sky.finish(NAME, JobState.SETTING_UP)
        scene.work()
    scene.repeated_work.clear()  # the process is killed: its threads are gone
    scene.cloud = scene.another_process()
    assert [m.id for m in scene.machines()] == [ID]
    if stage in ("asked", "booted", "setting up"):
        scene.sky.finish(NAME)
    scene.work()
    expected = MachinePhase.FAILED if stage == "failed" else MachinePhase.RUNNING
    assert scene.machine().phase is expected
    assert scene.sky.asked("launch") == [NAME]


def test_a_process_killed_before_skypilot_heard_leaves_a_failed_launch_not_a_lost_one(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
):
    class Killed(BaseException):
        pass

    def launch(*_: object) -> str:
        raise Killed

    monkeypatch.setattr(scene.sky, "launch", launch)
    with pytest.raises(Killed):
        scene.cloud.launch(scene.order())
    scene.cloud = scene.another_process()
    assert scene.machine().phase is MachinePhase.PROVISIONING
    scene.work()
    scene.pass_s(ASK_LIMIT_S)
    scene.work()
    assert scene.machine().phase is MachinePhase.FAILED


def test_a_process_killed_while_it_ends_a_machine_leaves_it_listed(scene: Scene):
    scene.launched()
    scene.sky.fail_next("down", CloudUnreachable("killed"), times=5)
    with pytest.raises(CloudUnreachable):
        scene.cloud.terminate(ID)
    scene.cloud = scene.another_process()
    machine = scene.machine()
    assert (machine.phase, machine.failure) == (
        MachinePhase.FAILED,
        Reason(Cause.ERROR, words="its end was not confirmed"),
    )


def test_down_while_launching_aborts_the_launch(scene: Scene):
    scene.cloud.launch(scene.order())
    scene.sky.boot(NAME)
    scene.cloud.terminate(ID)
    assert scene.sky.asked("cancel")
    assert not scene.provider.found
    assert not scene.machines()
    scene.work()
    assert not scene.machines(), "a follower that was late brings nothing back"


def test_a_replica_ended_by_another_process_while_it_was_ordered_does_not_run(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
):
    real = scene.sky.launch

    def launch(task: dict, name: str, group: str) -> str:
        request = real(task, name, group)
        scene.another_process().terminate(ID)
        scene.sky.boot(name)  # SkyPilot was a moment too fast for the abort
        return request

    monkeypatch.setattr(scene.sky, "launch", launch)
    scene.cloud.launch(scene.order())
    assert not scene.provider.found
    assert not scene.machines()


UNAVAILABLE = "ResourcesUnavailableError", "Failed to acquire resources in us-east-1a"
EXIT = "SystemExit", "1"


@pytest.mark.parametrize(
    ("log", "cause", "kind", "text"),
    [
        (
            "D (UnauthorizedOperation) User: lab is not authorized to perform",
            Cause.CREDENTIALS,
            *UNAVAILABLE,
        ),
        ("D (AccessDenied) when calling GetInstanceProfile", Cause.CREDENTIALS, *EXIT),
        ("D (VcpuLimitExceeded) more vCPU capacity than your limit", Cause.QUOTA, *UNAVAILABLE),
        (
            "D (InsufficientInstanceCapacity) there is no Spot capacity",
            Cause.CAPACITY,
            *UNAVAILABLE,
        ),
        ("I nothing to the point", Cause.CAPACITY, *UNAVAILABLE),
    ],
)
def test_what_skypilot_keeps_to_its_log_decides_why_a_launch_failed(
    scene: Scene, log: str, cause: Cause, kind: str, text: str
):
    """Its error says "no resources" of all of these, or "1", and nothing of what AWS said."""
    scene.cloud.launch(scene.order())
    scene.sky.provision_logs[NAME] = f"{log}\nI Terminating the failed cluster.\n"
    scene.sky.fail(NAME, kind, text)
    scene.work()
    failure = scene.machine().failure
    assert failure is not None
    assert failure.cause is cause


# -- logs ---------------------------------------------------------------------------------------


def test_the_log_is_fetched_from_the_machine(scene: Scene):
    scene.launched()
    scene.sky.job_logs[NAME] = "replica_started\n"
    path = scene.cloud.log(ID)
    assert path is not None
    assert Path(path).read_text() == "replica_started\n"


def test_secrets_stay_private_on_disk(scene: Scene):
    scene.cloud.launch(scene.order())
    key = scene.cloud.journal.files(ID) / "replica.key"
    assert key.stat().st_mode & 0o077 == 0
    assert key.parent.stat().st_mode & 0o077 == 0
    assert b"secret" not in b"".join(p.read_bytes() for p in key.parent.parent.glob("*.json"))


# -- what a machine is given ------------------------------------------------------------------


def test_what_a_machine_need_not_have_is_told(scene: Scene):
    assert scene.cloud.exposures(["aws"], open_port=None) == []
    scene.sky.uploaded = ["~/.lambda_cloud/lambda_keys"]
    scene.provider.mighty = "the role may do anything"
    role, files, port = scene.cloud.exposures(["aws"], open_port=7448)
    assert role == "the role may do anything"
    assert "`~/.lambda_cloud/lambda_keys`" in files
    assert "port 7448 of every VM (mutual TLS) and ssh's port (keys only) are open" in port
    assert scene.cloud.exposures(["gcp"], open_port=None) == [files], "of the clouds asked about"
    scene.sky.uploaded = None
    assert "the remote API server decides" in scene.cloud.exposures(["gcp"], open_port=None)[0]


# -- what a machine installs -------------------------------------------------------------------


def no_index(wheel: Path) -> Locks:
    raise CloudError("nobody answers")


def resolves(version: str) -> Callable[[Path], Locks]:
    return lambda wheel: Locks({"requirements.txt": f"rich=={version}"})


def test_a_generation_keeps_its_lock_and_the_next_one_gets_what_up_made_last(scene: Scene):
    """Also in another process, and where no index can be reached any more."""
    scene.make_lock = resolves("1")
    cloud = scene.another_process()
    assert cloud.exposures(["aws"], open_port=None) == []
    cloud.launch(scene.order())
    scene.make_lock = resolves("2")
    cloud = scene.another_process()
    assert cloud.exposures(["aws"], open_port=None) == []
    cloud.launch(scene.order(replica(1)))
    scene.make_lock = no_index
    cloud = scene.another_process()
    assert cloud.exposures(["aws"], open_port=None) == []
    cloud.launch(scene.order(replica(2), spec_hash="next"))
    locks = [cloud.journal.files(replica(slot)) / "requirements.txt" for slot in range(3)]
    assert [one.read_text() for one in locks] == ["rich==1", "rich==1", "rich==2"]


def test_without_an_index_it_is_told_and_a_whole_generation_has_no_lock(scene: Scene):
    scene.make_lock = no_index
    cloud = scene.another_process()
    [told] = cloud.exposures(["aws"], open_port=None)
    assert told == (
        "the packages that fogft needs are not pinned, and each VM resolves them itself: "
        "nobody answers"
    )
    cloud.launch(scene.order())
    scene.make_lock = resolves("1")
    cloud = scene.another_process()
    cloud.launch(scene.order(replica(1)))
    assert not list((scene.folder / "state").rglob("requirements*.txt"))


# -- who may connect ----------------------------------------------------------------------------

LAB = ("203.0.113.0/24",)


@pytest.mark.parametrize(("dials_out", "ports"), [(False, "[22, 7448]"), (True, "[22]")])
def test_a_machine_lets_in_whom_its_pool_names_and_nobody_else(
    scene: Scene, dials_out: bool, ports: str
):
    scene.cloud.launch(scene.order(allow_from=LAB, dials_out=dials_out))
    scene.cloud.launch(scene.order(replica(1)))
    assert [one.group for one in scene.sky.launched] == [f"us-east-1 {ports} {list(LAB)}", ""]


def test_where_nobody_can_be_kept_out_nothing_is_launched(scene: Scene):
    scene.provider.allowed = False
    with pytest.raises(
        CloudError, match=r"`fogft\.allow_from` cannot be enforced in `aws/us-east-1"
    ):
        scene.cloud.launch(scene.order(allow_from=LAB))
    scene.provider.allowed, scene.provider.reachable = True, False
    with pytest.raises(CloudUnreachable):
        scene.cloud.launch(scene.order(allow_from=LAB))
    assert not scene.sky.launched
    assert not scene.cloud.journal.entries()


def test_a_cloud_that_lets_everybody_in_all_the_same_is_told(scene: Scene):
    (told,) = scene.cloud.exposures(["aws", "gcp"], open_port=None, allow_from=LAB)
    assert told.startswith("on `gcp`, ssh's port")
    assert scene.cloud.exposures(["aws"], open_port=7448, allow_from=LAB) == []
    elsewhere = scene.order(place=Placement("gcp", "us-east1", "", "n2"), allow_from=LAB)
    scene.cloud.launch(elsewhere)
    assert scene.sky.launched[-1].group == ""


# -- ports ------------------------------------------------------------------------------------

MAPPED = Placement("runpod", "CA", "CA-MTL-1", "1x_A40")


def test_the_links_port_is_the_orders_and_survives_a_lost_journal(scene: Scene):
    scene.cloud.launch(scene.order(link_port=9000))
    scene.sky.finish(NAME)
    scene.work()
    assert (scene.machine().endpoint or "").endswith(":9000")
    shutil.rmtree(scene.folder / "state")
    assert (scene.machines(scene.another_process())[0].endpoint or "").endswith(":9000")


@pytest.mark.parametrize("by_s", [3600.0, -3600.0])
def test_a_clock_that_is_set_ends_no_launch_and_delays_the_end_of_none(scene: Scene, by_s):
    scene.cloud.launch(scene.order())
    scene.work()
    scene.set_s += by_s
    scene.work()
    assert scene.machine().phase is MachinePhase.PROVISIONING
    scene.pass_s(LAUNCH_LIMIT_S)
    scene.work()
    assert scene.machine().phase is MachinePhase.FAILED


def test_a_failed_setup_is_seen_soon_though_the_clock_was_set_back(scene: Scene):
    scene.cloud.launch(scene.order())
    scene.sky.finish(NAME, JobState.SETTING_UP)
    scene.work(LOOKED_AT)
    scene.set_s -= 3600.0
    scene.sky.jobs[NAME] = JobState.SETUP_FAILED
    scene.work(LOOKED_AT)
    assert scene.machine().failure.cause is Cause.SETUP


def test_a_full_disk_keeps_no_machine(scene: Scene, monkeypatch):
    """Its end cannot be written down, and is asked for all the same."""
    scene.launched()
    full = StateError("no space is left")

    def refuse(*_args, **_changes):
        raise full

    monkeypatch.setattr(scene.cloud.journal, "update", refuse)
    scene.cloud.terminate(replica())
    assert scene.sky.asked("down") == [NAME]
    assert scene.machines() == []


def test_a_launch_that_fails_on_a_full_disk_is_ended_and_forgotten(scene: Scene, monkeypatch):
    """Why it failed cannot be kept; it is not ended again and again for that."""
    scene.cloud.launch(scene.order())
    scene.sky.boot(NAME)
    scene.sky.finish(NAME)

    def refuse(*_args, **_changes):
        raise StateError("no space is left")

    monkeypatch.setattr(scene.cloud.journal, "update", refuse)
    scene.sky.fail(NAME, "CommandError", "Command failed with return code 1")
    scene.work()
    assert not scene.provider.found
    assert scene.machines() == []
    assert len(scene.sky.asked("down")) == 1


def test_whose_machines_they_are_is_known_without_a_users_name_and_by_the_computer(
    tmp_path, monkeypatch
):
    """Robots of one image have one user and one host name; a container's user often has none."""

    def nobody():
        raise KeyError("getpwuid(): uid not found: 1001")

    monkeypatch.setattr(adapter.getpass, "getuser", nobody)
    owners = []
    for id in (b"one\n", b"two\n"):
        (tmp_path / "id").write_bytes(id)
        monkeypatch.setattr(adapter, "MACHINE_ID", tmp_path / "id")
        owners.append(adapter.make(tmp_path).owner)
    assert owners[0] != owners[1]
    assert all(owner.startswith(f"uid{os.getuid()}-") for owner in owners)
    monkeypatch.setattr(adapter, "MACHINE_ID", tmp_path / "none")
    assert adapter.make(tmp_path).owner not in owners


def test_where_a_cloud_maps_ports_skypilot_says_how_a_machine_is_reached(scene: Scene):
    """Its own address and port are of no use; until the mapping is known there is no endpoint."""
    scene.cloud.launch(scene.order(place=MAPPED))
    scene.sky.finish(NAME)
    scene.work()
    assert scene.machine().phase is MachinePhase.RUNNING
    assert scene.machine().endpoint is None
    scene.sky.jobs[NAME] = JobState.SETTING_UP
    scene.sky.mapped[NAME] = "203.0.113.9:31022"
    scene.pass_s(JOB_PAUSE_S)
    scene.work()
    assert scene.machine().endpoint == "203.0.113.9:31022"
    assert scene.machines(scene.another_process())[0].endpoint == "203.0.113.9:31022"


def test_a_replica_that_dials_out_needs_no_mapped_port(scene: Scene):
    scene.cloud.launch(scene.order(place=MAPPED, dials_out=True))
    scene.sky.finish(NAME)
    scene.work()
    assert scene.sky.asked("endpoint") == []


def test_a_cloud_that_opens_no_port_is_told_with_what_helps(scene: Scene):
    refused = RefusedError("NotSupportedError", ["Opening ports is not supported on Hyperbolic."])
    scene.sky.fail_next("launch", refused)
    with pytest.raises(CloudError) as caught:
        scene.cloud.launch(scene.order())
    assert "Opening ports is not supported" in caught.value.message
    assert "`fogft.dial_in`" in caught.value.hint


def test_credentials_that_end_before_the_pool_are_told_and_counted_down(scene: Scene):
    assert scene.cloud.credentials_end_at() is None
    scene.cloud.offers({"infra": "aws"})
    scene.provider.ends_at = scene.now + 2 * 3600
    scene.pass_s(60)
    assert scene.cloud.credentials_end_at() == scene.provider.ends_at
    assert scene.cloud.hindrances(["aws"], scene.now + 3600) == []
    for until in (None, scene.now + 9 * 3600):
        [said] = scene.cloud.hindrances(["aws"], until)
        assert said.startswith(
            "the credentials of `aws` expire in 2.0 h: after that, nothing is launched"
        )
    assert scene.cloud.hindrances(["gcp"], None) == []
    scene.sky.server_told = (
        "SkyPilot's API server is 0.14.0, and 0.14.1 is installed here: it is busy"
    )
    assert scene.cloud.hindrances(["gcp"], None) == [scene.sky.server_told]
    scene.provider.ends_at += 3600  # renewed
    assert scene.cloud.credentials_end_at() == scene.provider.ends_at - 3600
    scene.pass_s(60)
    assert scene.cloud.credentials_end_at() == scene.provider.ends_at


def test_when_a_machine_ran_and_when_it_was_set_up_is_known_to_the_next_process(scene: Scene):
    begun_at = scene.now
    scene.cloud.launch(scene.order())
    scene.pass_s(40)
    scene.sky.finish(NAME, JobState.SETTING_UP)
    scene.work(3)
    scene.pass_s(100)
    scene.sky.jobs[NAME] = JobState.RUNNING
    scene.work()
    machine = scene.machines(scene.another_process())[0]
    assert 40 <= machine.running_at - begun_at < 45
    assert 100 <= machine.set_up_at - machine.running_at < 115
