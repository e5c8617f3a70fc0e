"""Each failure of a cloud has a defined end for the whole pool, and a plain message."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from fogft.cloud.sky import prices
from fogft.cloud.sky.naming import cluster_name, infra
from fogft.cloud.sky.presence import PROVIDER_SURE_AFTER_S
from fogft.cloud.sky.sdk import JobState
from fogft.errors import CloudUnreachable
from fogft.model.intent import retry
from fogft.model.replica import Offer, ReplicaId
from fogft.planning.observed.backoff import LIMIT_S
from fogft.planning.observed.history import EventKind
from fogft.pool.manager import teardown
from tests.fakes.sky import EAST, WEST, labels, replica
from tests.sky.pool_on_sky import NORTH, UID, PoolOnSky

FIRST = cluster_name(replica(0, 1))
EVERYWHERE = {infra(EAST), infra(WEST), infra(NORTH)}


@pytest.fixture
def pool(tmp_path: Path) -> PoolOnSky:
    """One replica is wanted; launches succeed by themselves."""
    return PoolOnSky(tmp_path)


@pytest.fixture
def by_hand(pool: PoolOnSky) -> PoolOnSky:
    """The same, and the first launch, in the cheapest place, waits for the test to end it."""
    pool.sky.boots = False
    pool.tick(3)
    assert pool.ordered() == [infra(EAST)]
    return pool


def test_a_preempted_vm_is_replaced_at_the_first_late_answer(pool: PoolOnSky):
    """Before its link is suspect: the cloud says that it is gone. Elsewhere, and at once."""
    pool.until(pool.ready)
    pool.tick(int(PROVIDER_SURE_AFTER_S))
    pool.sky.boots = False
    pool.sky.preempt(FIRST)
    pool.late = {replica(0, 1): 0.65}
    pool.tick(2)
    assert pool.ordered() == [infra(EAST), infra(WEST)]
    pool.tick()
    assert FIRST not in pool.sky.records, "the dead record is cleaned up"


def test_late_answers_of_a_vm_that_runs_replace_nothing(pool: PoolOnSky):
    """As when the robot's uplink is gone for half an hour: the cloud is asked, ever less often."""
    pool.until(pool.ready)
    pool.tick(int(PROVIDER_SURE_AFTER_S))
    pool.late = {replica(0, 1): 1.9}
    asked_before = len(pool.scene.provider.asked_regions)
    pool.tick(1800)
    assert pool.ordered() == [infra(EAST)]
    assert pool.ready() == ["0.1"]
    questions = len(pool.scene.provider.asked_regions) - asked_before
    assert 2 <= questions <= 2 * 1800 / 60 + 20, "of these a census a minute"


def test_no_capacity_goes_on_in_the_next_location_and_is_remembered(pool: PoolOnSky):
    """The full place rests; it is not asked again as long as another one is left."""
    pool.sky.full = {infra(EAST)}
    pool.until(pool.ready)
    assert pool.ordered() == [infra(EAST), infra(WEST)]
    assert "capacity: no spot capacity" in pool.said()
    pool.sky.full = EVERYWHERE
    pool.sky.preempt(cluster_name(replica(0, 2)))
    pool.sky.records.clear()
    pool.until(lambda: "every location is backing off" in pool.notes)
    assert f"`{EAST.location}`: capacity" in pool.notes
    before = len(pool.ordered())
    pool.tick(30)
    assert len(pool.ordered()) - before <= 6, "each place rests longer each time"
    pool.sky.full = set()
    pool.until(pool.ready)


def test_a_quota_rests_the_location_for_long(by_hand: PoolOnSky):
    """Waiting a little does not help an account that may not have more."""
    by_hand.sky.fail(FIRST, "ResourcesUnavailableError", "MaxSpotInstanceCountExceeded: no more")
    by_hand.sky.boots = True
    by_hand.sky.full = {infra(WEST), infra(NORTH)}
    by_hand.until(lambda: f"`{EAST.location}`: quota" in by_hand.notes)
    assert "quota: MaxSpotInstanceCountExceeded: no more" in by_hand.said()
    by_hand.tick(int(LIMIT_S) - 60)
    assert by_hand.ordered().count(infra(EAST)) == 1
    by_hand.until(by_hand.ready)
    assert by_hand.ordered()[-1] == infra(EAST)


def test_credentials_that_expire_take_nothing_away(pool: PoolOnSky):
    """Cannot tell is not gone: hours later the same replicas run, and the user knows why."""
    pool.until(pool.ready)
    before = (pool.ordered(), pool.store.published)
    expired = CloudUnreachable(
        "SkyPilot did not answer about the list of clusters: ExpiredToken",
        "renew the credentials of this cloud; `sky check` tests them",
    )
    pool.sky.fail_next("clusters", expired, times=1000)
    pool.tick(100, seconds=60)
    assert pool.notes.startswith("the cloud cannot be reached: nothing is launched or ended")
    assert "ExpiredToken; renew the credentials of this cloud" in pool.notes
    assert (pool.ordered(), pool.store.published) == before
    pool.sky.errors.clear()
    pool.until(pool.ready)
    assert (pool.ordered(), pool.running()) == (before[0], ["0.1"])


@pytest.mark.parametrize("minutes", [1, 10, 60])
def test_an_api_server_that_hangs_or_answers_500_costs_no_replica(tmp_path: Path, minutes: int):
    """Nothing is concluded, launched or ended; afterwards the same replicas are there."""
    pool = PoolOnSky(tmp_path, replicas=2)
    pool.until(lambda: len(pool.ready()) == 2)
    before = pool.ordered(), pool.running(), pool.store.published
    pool.sky.unreachable = True
    pool.tick(60, seconds=minutes)
    assert (pool.ordered(), pool.running(), pool.store.published) == before
    assert "the cloud did not answer" in pool.notes
    pool.sky.unreachable = False
    pool.tick(30)
    assert (pool.ordered(), pool.running(), len(pool.ready())) == (*before[:2], 2)


def test_an_api_server_that_dies_in_mid_launch_costs_no_second_vm(by_hand: PoolOnSky):
    by_hand.sky.boot(FIRST)
    by_hand.sky.unreachable = True
    by_hand.tick(60)
    assert "the cloud did not answer: SkyPilot did not answer" in by_hand.notes
    by_hand.sky.finish(FIRST)
    by_hand.sky.unreachable = False
    by_hand.until(by_hand.ready)
    assert (by_hand.ordered(), by_hand.running()) == ([infra(EAST)], ["0.1"])


def test_an_api_server_that_lost_the_launch_leaves_no_vm(by_hand: PoolOnSky):
    """Its database was put in place of another: the machine is found by its label and ended."""
    by_hand.sky.boot(FIRST)
    by_hand.sky.forget_everything()
    by_hand.sky.boots = True
    by_hand.until(by_hand.ready)
    assert "SkyPilot lost this launch" in by_hand.said()
    assert by_hand.running() == by_hand.ready() == ["0.2"]


@pytest.mark.parametrize("state", ["INIT", "UP"])
def test_a_launch_that_fails_after_the_vm_was_made_leaves_no_vm(by_hand: PoolOnSky, state: str):
    """Also when SkyPilot calls it UP."""
    by_hand.sky.boot(FIRST)
    if state == "UP":
        by_hand.sky.finish(FIRST)
    by_hand.sky.fail(FIRST, "ClusterSetUpError", "the runtime could not be installed")
    by_hand.sky.boots = True
    by_hand.until(by_hand.ready)
    assert "error: the runtime could not be installed" in by_hand.said()
    assert by_hand.running() == by_hand.ready() == ["0.2"]
    assert by_hand.ordered() == [infra(EAST), infra(WEST)]


def test_a_launch_that_hangs_is_ended_and_made_elsewhere(by_hand: PoolOnSky):
    by_hand.sky.boot(FIRST)
    by_hand.until(lambda: len(by_hand.ordered()) == 2, limit=1000)
    by_hand.sky.boots = True
    by_hand.until(by_hand.ready)
    assert "timeout: " in by_hand.said()
    assert by_hand.sky.asked("cancel"), "SkyPilot was told to give up"
    assert by_hand.running() == by_hand.ready() == ["0.2"]
    assert by_hand.ordered()[1] != infra(EAST)


def test_a_failed_setup_shows_its_last_words_and_tours_no_other_region(by_hand: PoolOnSky):
    """The file is at fault: no VM is left, and the next try waits, longer each time."""
    by_hand.sky.job_logs[FIRST] = "collecting numpy\nerror: no package `nunpy`\n"
    by_hand.sky.finish(FIRST, JobState.SETUP_FAILED)
    by_hand.until(lambda: "waiting after 1 failed launches (setup)" in by_hand.notes)
    assert "setup: `setup` failed\ncollecting numpy\nerror: no package `nunpy`" in by_hand.said()
    assert by_hand.running() == []
    assert by_hand.ordered() == [infra(EAST)]


@pytest.mark.parametrize("phase", ["ordered", "booted", "finished", "failed", "ready", "ending"])
def test_a_manager_killed_in_any_phase_leaves_one_vm(by_hand: PoolOnSky, phase: str):
    """Neither a VM that nobody knows nor a second one for the same slot."""
    sky = by_hand.sky
    if phase != "ordered":
        sky.boot(FIRST)
    if phase == "finished":
        sky.finish(FIRST)
    if phase == "failed":
        sky.fail(FIRST, "ClusterSetUpError", "the runtime could not be installed")
    if phase in ("ready", "ending"):
        sky.finish(FIRST)
        by_hand.until(by_hand.ready)
    if phase == "ending":
        sky.fail_next("down", CloudUnreachable("no answer"), times=3)
        by_hand.leaving.add(replica(0, 1))
        sky.boots = True
        by_hand.until(lambda: sky.asked("down"))
    by_hand.kill_the_manager()
    sky.boots = True
    by_hand.until(lambda: by_hand.ready() and by_hand.running() == by_hand.ready())
    by_hand.tick(30)
    assert len(by_hand.running()) == 1
    assert by_hand.running() == by_hand.ready()


@pytest.mark.parametrize("booted", [False, True])
def test_down_while_launching_leaves_nothing(by_hand: PoolOnSky, booted: bool):
    """The manager was killed in mid launch; `down` aborts what it ordered, then ends it."""
    if booted:
        by_hand.sky.boot(FIRST)
    by_hand.kill_the_manager()
    ended: list[str] = []
    end(by_hand, ended)
    assert ended == ["replica 0.1 (aws/us-east-1/us-east-1a)"]
    assert by_hand.sky.asked("cancel") == ["r1"]
    assert by_hand.running() == []
    assert not by_hand.scene.machines()


def test_down_finds_a_launch_that_skypilot_hears_of_late(pool: PoolOnSky):
    """Killed in mid order: nothing is listed at the first look, and a VM boots after it."""
    scene = pool.scene
    unheard = CloudUnreachable("the connection was cut")
    scene.sky.fail_next("launch", unheard)
    with pytest.raises(CloudUnreachable):
        scene.cloud.launch(scene.order())
    passing = scene.pass_s

    def heard_meanwhile(seconds: float) -> None:
        scene.pass_s = passing  # type: ignore[method-assign]
        passing(seconds)
        labels = scene.order().id
        scene.sky.launch({"resources": resources(labels)}, FIRST)
        scene.sky.boot(FIRST)

    scene.pass_s = heard_meanwhile  # type: ignore[method-assign]
    scene.cloud = scene.another_process()
    end(pool, [])
    assert pool.running() == []
    assert pool.sky.asked("cancel")


def test_down_in_mid_launch_waits_until_a_cloud_must_list_what_was_just_made(pool: PoolOnSky):
    """Clouds list a machine seconds after it was made: SkyPilot's own `down` misses it as well."""
    scene = pool.scene
    scene.cloud.launch(scene.order())
    scene.sky.boot(FIRST)
    (key, made), begun_at = pool.sky.provider.found.popitem(), scene.now
    scene.sky.down_forgets = True
    passing = scene.pass_s

    def listed_after_8_s(seconds: float) -> None:
        passing(seconds)
        if scene.now >= begun_at + 8 and not pool.sky.provider.terminated:
            pool.sky.provider.found[key] = made

    scene.pass_s = listed_after_8_s  # type: ignore[method-assign]
    scene.cloud = scene.another_process()
    end(pool, [])
    assert pool.sky.provider.terminated == [key]
    assert pool.running() == []


def test_down_without_an_answer_says_what_may_still_run_and_how_to_look(pool: PoolOnSky):
    pool.until(pool.ready)
    pool.scene.cloud = pool.scene.another_process()
    pool.sky.unreachable = True
    with pytest.raises(CloudUnreachable) as caught:
        end(pool, [], known=teardown.Known("perception", ("replica 0.1 (aws/us-east-1)",)))
    assert caught.value.message.splitlines() == [
        "cannot tell what is left of `perception`: SkyPilot did not answer",
        "  may still be running: replica 0.1 (aws/us-east-1)",
    ]
    pool.sky.unreachable = False
    pool.sky.fail_next("down", CloudUnreachable("AWS does not answer"), times=100)
    with pytest.raises(Exception, match="AWS does not answer") as stubborn:
        end(pool, [])
    assert "these replicas did not end: `0.1` (aws/us-east-1/us-east-1a)" in str(stubborn.value)
    assert f"`sky status --refresh {FIRST}`" in stubborn.value.hint  # type: ignore[attr-defined]
    pool.sky.errors.clear()
    end(pool, [])
    assert pool.running() == []


def test_a_notice_is_answered_while_the_machine_still_runs(pool: PoolOnSky):
    """Real clouds tell the machine alone: the replica asks to be left alone, over its link."""
    pool.until(pool.ready)
    pool.sky.boots = False
    pool.leaving.add(replica(0, 1))
    pool.tick(2)
    assert pool.ordered() == [infra(EAST), infra(WEST)]
    assert pool.ready() == ["0.1"], "it serves until the next one does"
    pool.sky.finish(cluster_name(replica(0, 2)))
    pool.until(lambda: pool.running() == ["0.2"])


def test_the_budget_counts_what_is_being_launched_and_is_never_exceeded(tmp_path: Path):
    """Two fit; a replacement waits for headroom, and says so."""
    cap = 0.055 + 2 * prices.extras_usd_per_hour(EAST, {})
    pool = PoolOnSky(tmp_path, replicas=2, max_usd_per_hour=cap)
    pool.sky.boots = False
    pool.tick(5)
    assert pool.ordered() == [infra(EAST), infra(WEST)]
    for slot in (0, 1):
        pool.sky.finish(cluster_name(replica(slot, 1)))
    pool.until(lambda: pool.ready() == ["0.1", "1.1"])
    pool.leaving.add(replica(0, 1))
    pool.tick(30)
    assert len(pool.ordered()) == 2
    assert "`max_usd_per_hour` leaves $0.005/h" in pool.notes
    pool.sky.preempt(FIRST)  # the notice comes true: its money is free again
    pool.sky.records.pop(FIRST)
    pool.until(lambda: len(pool.ordered()) == 3)
    running = [i.labels["fogft-microusd"] for i in pool.scene.provider.found.values()]
    assert sum(map(int, running)) <= cap * 1e6


def test_another_type_takes_the_place_of_one_without_capacity_where_the_cap_allows_it(
    tmp_path: Path,
):
    """The place does not rest, and what the machine costs is what its own type costs."""
    other = replace(EAST, instance="m5.large")
    more = prices.extras_usd_per_hour(EAST, {})
    for cap, came in ((None, "m5.large"), (0.06, "m5.large"), (0.04, "")):
        pool = PoolOnSky(tmp_path / str(cap), max_usd_per_hour=cap)
        pool.sky.sold = [Offer(EAST, 0.02, "catalogue"), Offer(other, 0.03, "catalogue")]
        pool.sky.full = {"m6i.large"}
        pool.tick(8)
        if not came:
            assert "capacity" in pool.said()
            continue
        assert pool.ready() == ["0.1"]
        assert "capacity" not in pool.said()
        [machine] = pool.scene.machines()
        assert (machine.placement, machine.usd_per_hour) == (other, pytest.approx(0.03 + more))


def test_hours_that_are_over_end_every_vm(pool: PoolOnSky):
    pool.until(pool.ready)
    pool.change(max_hours=1.0)
    pool.tick(70, seconds=60)
    assert "`max_hours` has passed" in pool.said()
    assert pool.running() == []
    assert pool.ordered() == [infra(EAST)]


def end(pool: PoolOnSky, ended: list[str], known: teardown.Known | None = None) -> None:
    """Do with the machines what `down` does."""
    teardown.end_machines(
        pool.scene.cloud,
        UID,
        known=known or teardown.Known("perception", clouds=frozenset({"aws"})),
        done=ended.append,
        warned=lambda what: pytest.fail(what),
        limit_s=0.0,
    )


def resources(id: ReplicaId) -> dict[str, object]:
    """Return the resources of an order for `EAST`, as SkyPilot gets them."""
    return {
        "infra": infra(EAST), "instance_type": "m6i.large", "use_spot": True, "labels": labels(id)
    }  # fmt: skip


# -- pools that are slow, or never ready -------------------------------------------------------

HOUR_S = 3600.0


def test_a_set_up_that_takes_longer_than_a_start_may_is_waited_for(tmp_path: Path):
    """`start_limit_s` counts from the end of `setup`: one launch a replica, and the pool serves."""
    pool = PoolOnSky(tmp_path, replicas=3)
    pool.sky.boots = False
    began: dict[str, float] = {}

    def set_up() -> None:
        for one in pool.sky.launched:
            if one.request.active:
                pool.sky.finish(one.name, JobState.SETTING_UP)
                began[one.name] = pool.scene.now
            elif pool.scene.now - began[one.name] > 1000.0:
                pool.sky.jobs[one.name] = JobState.RUNNING

    pool.serves = lambda name: pool.sky.jobs[name] is JobState.RUNNING
    for _ in range(400):
        set_up()
        pool.tick(seconds=5.0)
    assert pool.ready() == ["0.1", "1.1", "2.1"]
    assert len(pool.ordered()) == 3


def never_ready(folder: Path) -> PoolOnSky:
    """A pool whose service never comes, after twelve hours."""
    pool = PoolOnSky(folder, replicas=3)
    pool.serves = lambda name: False
    pool.sky.job_logs = dict.fromkeys(
        (cluster_name(replica(slot, n)) for slot in range(3) for n in (1, 2)), "no module `plan`"
    )
    pool.tick(int(12 * HOUR_S / 10), seconds=10.0)
    return pool


def test_a_service_that_is_never_ready_is_launched_twice_a_slot_and_no_more(tmp_path: Path):
    """It would bill for ever: the pool says so, with the log, and waits for the user."""
    pool = never_ready(tmp_path)
    assert len(pool.ordered()) == 6
    assert pool.running() == []
    assert "no replica of this file was ever ready" in pool.notes
    assert "not ready after 900 s" in pool.notes
    assert "no module `plan`" in pool.notes
    rests = [event for event in pool.store.events if event.kind is EventKind.FAILED]
    assert len(rests) == 6


def test_what_was_given_up_is_launched_again_when_asked_or_when_the_file_changes(tmp_path: Path):
    pool = never_ready(tmp_path)
    pool.kill_the_manager()
    pool.tick(60)
    assert len(pool.ordered()) == 6, "it is remembered"
    pool.store.the_intent = retry(pool.store.the_intent, pool.scene.now)
    pool.tick(int(4 * HOUR_S / 10), seconds=10.0)
    assert len(pool.ordered()) == 12
    pool.change(task={"run": "serve --better", "resources": {"infra": "aws"}})
    pool.serves = lambda name: True
    pool.until(lambda: len(pool.ready()) == 3)
    assert "ever ready" not in pool.notes


def test_a_version_that_was_ready_once_is_never_given_up(tmp_path: Path):
    """What it needs may be away for a while: it is tried on, within the hour's limit."""
    pool = PoolOnSky(tmp_path)
    pool.until(pool.ready)
    pool.serves = lambda name: False
    pool.sky.preempt(FIRST)
    pool.tick(int(6 * HOUR_S / 10), seconds=10.0)
    assert len(pool.ordered()) > 4
    pool.serves = lambda name: True
    pool.until(pool.ready)
