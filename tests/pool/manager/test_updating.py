"""The good file and the one on trial, on disk: what is in force, and what makes a rollback void."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fogft.model.reason import Cause, Reason
from fogft.model.replica import Member, Membership, Observed
from fogft.model.spec import PoolSpec
from fogft.planning.observed.history import Event, EventKind
from fogft.planning.rollout import Trial
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import Identity, PoolStore, write_identity
from fogft.pool.manager.proxy_report import parse as parse_report
from fogft.pool.manager.updating import Updating
from fogft.proxy.robot.client import ClientProxy
from fogft.proxy.robot.dispatcher import Dispatcher
from tests.fakes.proxy import Clock, FakeDialer, FakeNode
from tests.planning.pool_worlds import NOW, SERVICE, UID, World, replica


def parse(text: str, file: str) -> PoolSpec:
    return PoolSpec("pool", (SERVICE,), replicas=1, task={"run": text})


@pytest.fixture
def store(tmp_path) -> PoolStore:
    paths = PoolPaths(tmp_path)
    write_identity(paths, Identity("pool", UID, "local", "/pool.yaml", 0.0))
    paths.spec.write_text("good")
    return PoolStore(paths, parse, lambda: NOW)


def whole(store: PoolStore, **others: object) -> World:
    """Return a world in which the file in force is wholly ready."""
    return replace(World(store.spec()).having(replica(0, of=store.spec())), **others)


def tick(store: PoolStore, world: World) -> PoolSpec:
    from fogft.planning.observed.health import judge

    updating, observed = Updating(store), world.observed
    spec, trial = updating.look(UID, observed, world.history)
    health = judge(UID, spec, observed, world.history)
    updating.settle(spec, trial, health, wanted=1, now=world.now)
    return spec


def broken(store: PoolStore) -> World:
    part = replica(1, 2, state="unready", of=store.spec(), age_s=20)
    assert part.link is not None
    return World(store.spec()).having(replace(part, link=replace(part.link, restarts=9)))


def run(store: PoolStore) -> str:
    return store.spec().task["run"]


def test_the_first_file_that_is_wholly_ready_is_kept_byte_for_byte(store):
    assert store.good() is None
    tick(store, World(store.spec()))
    assert store.good() is None, "nothing serves yet"
    tick(store, whole(store))
    assert store.paths.good_spec.read_text() == "good"


def test_a_rollback_puts_the_good_file_in_force_and_stays_over_a_restart(store):
    tick(store, whole(store))
    store.paths.spec.write_text("bad")
    assert tick(store, broken(store)).task["run"] == "good"
    again = PoolStore(store.paths, parse, lambda: NOW)
    assert (run(store), run(again)) == ("good", "good")
    fault = again.trial().fault
    assert fault is not None
    assert [(why.cause, why.count) for why in fault.because] == [(Cause.RUN_ENDS, 9)]
    assert tick(again, whole(again)).task["run"] == "good"
    assert store.paths.good_spec.read_text() == "good"
    told = [(event.kind, event.reason) for event in store.recent()]
    assert told == [(EventKind.UPDATING, None), (EventKind.UPDATE_STOPPED, fault)]


def test_another_file_is_tried_and_the_bad_one_again_after_it(store):
    tick(store, whole(store))
    store.paths.spec.write_text("bad")
    tick(store, broken(store))
    store.paths.spec.write_text("mended")
    assert run(store) == "mended"
    tick(store, World(store.spec()))
    assert not store.trial().fault
    store.paths.spec.write_text("bad")
    assert run(store) == "bad"


def test_damaged_memory_tries_again_and_breaks_nothing(store):
    tick(store, whole(store))
    store.paths.spec.write_text("bad")
    tick(store, broken(store))
    for garbage in (b"", b"{", b"[1]", b'{"file": 1, "more": 2}'):
        store.paths.trial.write_bytes(garbage)
        assert run(store) == "bad"
        assert store.trial() == Trial()
    store.write_trial(Trial(store.applied(), 1.0, Reason(Cause.ERROR)))
    assert run(store) == "good"
    store.paths.good_spec.unlink()
    assert run(store) == "bad", "nothing to go back to"


def test_nothing_is_judged_while_the_cloud_cannot_be_reached(store):
    tick(store, whole(store))
    store.paths.spec.write_text("bad")
    world = broken(store)
    observed = replace(world.observed, machines=None)
    spec, trial = Updating(store).look(UID, observed, world.history)
    assert (spec.task["run"], trial.fault) == ("bad", None)
    assert isinstance(observed, Observed)


def test_a_file_that_changed_between_reading_and_keeping_is_not_called_good(store):
    """`up` may write while a tick runs: what was read is what is judged."""
    read = store.spec()
    store.paths.spec.write_text("newer")
    assert store.spec() is not read
    assert not store.keep_good(read)
    assert not store.paths.good_spec.exists()


def test_an_update_begins_when_the_manager_first_sees_it(store):
    """What failed before does not speak against it."""
    tick(store, whole(store))
    store.paths.spec.write_text("next")
    failures = [
        Event(NOW - 9 + n, kind, 1, n + 2, "east/one/a", Reason(Cause.ERROR))
        for n in range(3)
        for kind in (EventKind.LAUNCH, EventKind.REFUSED)
    ]
    world = World(store.spec()).having(replica(0, of=parse("good", "")))
    tick(store, replace(world, events=(*world.events, *failures)))
    assert store.trial().began_at == NOW
    assert not store.trial().fault


def test_answers_that_say_no_end_an_update_and_bring_the_good_file_back(store):
    """From the robot's requests to the file in force, with all parts between but processes.

    The new version serves and answers, but with `success: false`; each request is answered all
    the same, by the old version. What the proxy reports of it is proof enough.
    """
    tick(store, whole(store))
    store_paths = store.paths
    store_paths.spec.write_text("new")
    old, new = replica(0, of=store.good()), replica(1, 2, of=store.spec())
    assert run(store) == "new"
    clock, dialer, node = Clock(), FakeDialer(), FakeNode()
    proxy = ClientProxy(
        UID, node, dialer,
        lambda spec, respond, wake: Dispatcher(
            spec, respond, ok_of=lambda field: lambda payload: payload == b"yes", wake=wake,
            clock=clock,
        ),
        clock=clock,
    )  # fmt: skip
    service = replace(SERVICE, ok_field="success")
    proxy.serve([service])
    members = tuple(Member(part.machine.id, f"h:{part.machine.id.slot}") for part in (old, new))
    proxy.follow(Membership("pool", UID, 1, 1, members))
    for link in dialer.links:
        link.ready = frozenset({service.name})
        proxy.changed(link)
    proxy.run_once(0)
    by_slot = {link.peer.id.slot: link for link in dialer.links}
    for number in range(20):
        node.servers[service.name].on_request(b"q", number)
        for slot, payload in ((1, b"no"), (0, b"yes")):
            proxy.answered(by_slot[slot], by_slot[slot].reply(payload))
    assert [answer for _, answer in node.servers[service.name].responses] == [b"yes"] * 20
    report = parse_report({"pid": 1, "written_at": NOW, **proxy.report()}, UID)
    assert report is not None
    world = replace(World(store.spec()).having(old, new), links=report.links)
    tick(store, world)
    assert run(store) == "good"
    fault = store.trial().fault
    assert fault is not None
    assert fault.cause is Cause.MORE_ERRORS
    assert [(one.count, one.of) for one in fault.because] == [(20, 20), (0, 20)]
