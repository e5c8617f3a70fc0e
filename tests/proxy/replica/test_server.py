"""The replica is ready only while its command lives and its services are discovered."""

from __future__ import annotations

import pytest

from fogft.link.port import Probe
from fogft.model.plain import from_plain, to_plain
from fogft.model.replica import ReplicaId
from fogft.model.spec import ServiceSpec
from fogft.model.topic import ActionSpec
from fogft.poolfile.pool import action_services
from fogft.proxy.replica.server import ServerProxy
from tests.fakes.proxy import (
    UID,
    Clock,
    FakeIncoming,
    FakeListener,
    FakeNode,
    FakeSupervisor,
    lease,
)

HEADER = b"\0\1\0\0"
ACCEPTED, UNKNOWN, SUCCEEDED = HEADER + b"\1", HEADER + b"\0", HEADER + b"\4"


class Scene:
    def __init__(self, *services: ServiceSpec, spare: FakeSupervisor | None = None) -> None:
        self.clock = Clock()
        self.listener = FakeListener()
        self.supervisor = FakeSupervisor(7)
        self.nodes: list[FakeNode] = []
        self.proxy = ServerProxy(
            ReplicaId(UID, 2, 3),
            services or (ServiceSpec("/s", "std_srvs/srv/SetBool"),),
            self.listener,
            lambda: self.make_node(),
            self.supervisor,  # type: ignore[arg-type]
            spare=spare,  # type: ignore[arg-type]
            clock=self.clock,
        )
        self.proxy.start()

    def make_node(self) -> FakeNode:
        self.nodes.append(FakeNode())
        return self.nodes[-1]

    def client(self):
        return self.nodes[-1].clients["/s"]

    def probe(self):
        return self.listener.on_probe(Probe("robot"))


def test_ready_when_the_command_lives_and_the_service_is_discovered():
    scene = Scene()
    assert scene.probe().ready == frozenset()
    scene.proxy.run_once()
    assert scene.probe().ready == {"/s"}


@pytest.mark.parametrize("what", ["there", "known"])
def test_not_ready_while_discovery_does_not_find_the_service_or_it_us(what):
    scene = Scene()
    setattr(scene.client(), what, False)
    scene.proxy.run_once()
    answer = scene.probe()
    assert answer.ready == frozenset()
    assert answer.detail == "`run` does not offer /s yet"


def test_not_ready_while_the_service_is_on_another_middleware():
    """Discovery shows it, and it would never answer."""
    scene = Scene()
    scene.client().stranger = "`/s` runs on rmw_cyclonedds_cpp"
    scene.proxy.run_once()
    answer = scene.probe()
    assert answer.ready == frozenset()
    assert answer.detail == "`/s` runs on rmw_cyclonedds_cpp"
    scene.client().stranger = ""
    scene.proxy.run_once()
    assert scene.probe().ready == {"/s"}
    assert not scene.probe().detail


def test_a_probe_names_slot_and_generation():
    answer = Scene().probe()
    assert (answer.slot, answer.generation) == (2, 3)


def test_a_death_of_the_command_refuses_its_work_and_joins_ros_anew():
    """Discovery lists a dead service for seconds: only a new node knows only the living."""
    scene = Scene()
    scene.proxy.run_once()
    incoming = FakeIncoming(b"a" * 16)
    scene.listener.on_request(incoming)
    scene.supervisor.dies = True
    scene.proxy.run_once()
    assert incoming.outcome == ["refused crashed"]
    assert [node.closed for node in scene.nodes] == [True, False]
    assert scene.probe().restarts == 1


def test_requests_after_a_death_are_refused_until_the_service_is_back():
    scene = Scene()
    scene.proxy.run_once()
    scene.supervisor.dies = True
    original = scene.make_node
    scene.make_node = lambda: absent(original())
    scene.proxy.run_once()
    incoming = FakeIncoming(b"a" * 16)
    scene.listener.on_request(incoming)
    assert incoming.outcome == ["refused not-ready"]


def test_a_node_whose_take_loop_ended_is_replaced():
    """Nothing would ever be taken from it again, and the replica would still say ready."""
    scene = Scene()
    scene.proxy.run_once()
    incoming = FakeIncoming(b"a" * 16)
    scene.listener.on_request(incoming)
    scene.nodes[0].alive = False
    scene.proxy.run_once()
    assert incoming.outcome == ["refused crashed"]
    assert [node.closed for node in scene.nodes] == [True, False]
    assert scene.probe().ready == {"/s"}


def test_a_service_that_goes_while_the_command_lives_loses_its_work():
    """A frozen service is dropped by discovery; what it was given will not be answered."""
    scene = Scene()
    scene.proxy.run_once()
    incoming = FakeIncoming(b"a" * 16)
    scene.listener.on_request(incoming)
    scene.client().there = False
    scene.clock.now += 0.2
    scene.proxy.run_once()
    assert incoming.outcome == ["refused crashed"]
    assert len(scene.nodes) == 1


def test_a_service_that_the_command_restarts_by_itself_loses_its_work():
    """Discovery lists the dead server for seconds: that there is one more tells of its end."""
    scene = Scene()
    scene.proxy.run_once()
    incoming = FakeIncoming(b"a" * 16)
    scene.listener.on_request(incoming)
    scene.client().count = 2
    scene.clock.now += 0.2
    scene.proxy.run_once()
    assert incoming.outcome == ["refused crashed"]
    later = FakeIncoming(b"b" * 16)
    scene.listener.on_request(later)
    scene.client().count = 1
    scene.clock.now += 0.2
    scene.proxy.run_once()
    assert later.outcome == []


def hang(scene: Scene, *, remaining_s: float = 2.0) -> None:
    """Have a service that has answered in 0.1 s get two requests that it does not answer."""
    scene.proxy.run_once()
    for name in (b"a", b"b", b"c"):
        scene.listener.on_request(FakeIncoming(name * 16, remaining_s=remaining_s))
        if name == b"a":
            scene.clock.now += 0.1
            scene.client().calls[0][1](b"r")


def test_a_service_that_answers_nothing_of_what_it_has_is_told_and_then_started_anew():
    scene = Scene()
    hang(scene)
    scene.clock.now += 0.9
    assert scene.probe().hanging == frozenset()
    scene.clock.now += 1.0
    answer = scene.probe()
    assert (answer.ready, answer.hanging) == ({"/s"}, {"/s"})
    assert answer.detail == "`/s` has requests and has answered none for 2 s"
    for _ in range(600):
        scene.clock.now += 0.1
        scene.proxy.run_once()
    assert scene.supervisor.restarts == 1
    assert scene.probe().hanging == frozenset()


def test_a_service_that_answers_again_does_not_hang_any_more():
    scene = Scene()
    hang(scene)
    scene.clock.now += 30.0
    scene.proxy.run_once()
    scene.client().calls[1][1](b"r")
    assert scene.probe().hanging == frozenset()
    scene.clock.now += 45.0  # its longest answer took 30 s
    scene.proxy.run_once()
    assert (scene.supervisor.restarts, scene.probe().hanging) == (0, frozenset())


def test_a_long_call_and_a_service_that_has_never_answered_are_not_ended():
    """Who waits for an hour says that it may take an hour; a model may load at the first call."""
    scene = Scene()
    hang(scene, remaining_s=3600.0)
    new = Scene()
    new.proxy.run_once()
    for name in (b"a", b"b"):
        new.listener.on_request(FakeIncoming(name * 16, remaining_s=2.0))
    for one in (scene, new):
        for _ in range(100):
            one.clock.now += 10.0
            one.proxy.run_once()
        assert one.supervisor.restarts == 0


def absent(node: FakeNode) -> FakeNode:
    make = node.client

    def client(name, type_name):
        made = make(name, type_name)
        made.there = False
        return made

    node.client = client  # type: ignore[method-assign]
    return node


def test_it_says_how_long_it_serves_on_without_a_manager():
    """Robots' probes do not prolong it; only a lease that the manager signed does."""
    scene = Scene()
    assert scene.probe().lease_left_s is None
    scene.listener.signed = lease(1, at=1e9, lasts_s=60.0)
    scene.proxy.run_once()
    for _ in range(59):
        scene.clock.now += 1.0
        scene.probe()
        scene.proxy.run_once()
    assert (scene.probe().lease_age_s, scene.probe().lease_left_s) == (59.0, 1.0)
    assert not scene.proxy.lease_is_over
    scene.clock.now += 1.0
    assert scene.proxy.lease_is_over
    scene.listener.signed = lease(2, at=1e9 + 60.0, lasts_s=60.0)
    scene.proxy.run_once()
    assert scene.probe().lease_left_s == 60.0
    assert not scene.proxy.lease_is_over


def test_close_stops_the_command_and_leaves_the_wire_and_ros():
    scene = Scene()
    scene.proxy.run_once()
    incoming = FakeIncoming(b"a" * 16)
    scene.listener.on_request(incoming)
    scene.proxy.close()
    assert scene.supervisor.stopped
    assert scene.listener.closed
    assert scene.nodes[-1].closed
    assert incoming.outcome == ["refused crashed"]


def action() -> Scene:
    """A replica that offers an action, of which it knows what the manager writes for it."""
    parts = action_services(ActionSpec("/count", "p/action/T", 5.0, 60.0))
    told = [from_plain(ServiceSpec, to_plain(part)) for part in parts]
    scene = Scene(*told)
    scene.proxy.run_once()
    return scene


def test_a_result_of_a_goal_that_is_not_known_yet_is_not_kept_for_copies():
    scene = action()
    name = "/count/_action/get_result"
    for answer in (UNKNOWN, SUCCEEDED):
        incoming = FakeIncoming(b"a" * 16, HEADER + b"g" * 16, service=name)
        scene.listener.on_request(incoming)
        scene.nodes[-1].clients[name].calls[-1][1](answer)
        assert incoming.outcome == [answer]
    kept = FakeIncoming(b"a" * 16, HEADER + b"g" * 16, service=name)
    scene.listener.on_request(kept)
    assert kept.outcome == [SUCCEEDED]
    assert len(scene.nodes[-1].clients[name].calls) == 2


def test_a_goal_is_given_once_to_each_life_of_the_command():
    scene = action()
    name = "/count/_action/send_goal"

    def give(number: int) -> FakeIncoming:
        incoming = FakeIncoming(bytes([number]) * 16, HEADER + b"g" * 16, service=name)
        scene.listener.on_request(incoming)
        return incoming

    def calls() -> int:
        return len(scene.nodes[-1].clients[name].calls)

    first = give(1)
    scene.nodes[-1].clients[name].calls[0][1](ACCEPTED)
    assert first.outcome == give(2).outcome == [ACCEPTED]
    assert calls() == 1
    scene.nodes[-1].clients[name].there = False  # the server alone is gone for a moment
    scene.clock.now += 0.2
    scene.proxy.run_once()
    scene.nodes[-1].clients[name].there = True
    scene.proxy.run_once()
    give(3)
    assert calls() == 2
    scene.supervisor.dies = True
    scene.proxy.run_once()
    scene.proxy.run_once()
    give(4)
    assert (len(scene.nodes), calls()) == (2, 1)


def test_the_end_of_our_own_node_gives_no_goal_a_second_time():
    """The command lives on, with all goals that it has accepted."""
    scene = action()
    name = "/count/_action/send_goal"
    scene.listener.on_request(FakeIncoming(b"a" * 16, HEADER + b"g" * 16, service=name))
    scene.nodes[-1].clients[name].calls[0][1](ACCEPTED)
    scene.nodes[-1].alive = False
    scene.proxy.run_once()
    scene.proxy.run_once()
    again = FakeIncoming(b"b" * 16, HEADER + b"g" * 16, service=name)
    scene.listener.on_request(again)
    assert again.outcome == [ACCEPTED]
    assert (len(scene.nodes), scene.nodes[-1].clients[name].calls) == (2, [])


def test_a_spare_process_waits_for_the_first_and_takes_its_place():
    spare = FakeSupervisor(8)
    scene = Scene(spare=spare)
    scene.client().there = False
    scene.proxy.run_once()
    assert (scene.proxy.command, spare.alive) == (scene.supervisor, False)
    scene.client().there = True
    scene.proxy.run_once()  # ready, and so the spare one is started next
    scene.proxy.run_once()
    assert (scene.proxy.command, spare.alive) == (scene.supervisor, True)
    scene.supervisor.dies = True
    scene.proxy.run_once()
    assert (scene.proxy.command, scene.probe().restarts) == (spare, 1)
    spare.dies = True
    scene.proxy.run_once()
    assert scene.proxy.command is scene.supervisor
    scene.proxy.close()
    assert (scene.supervisor.stopped, spare.stopped) == (True, True)


def test_without_a_live_spare_process_the_first_is_started_again():
    spare = FakeSupervisor(8)
    scene = Scene(spare=spare)
    scene.supervisor.dies = True
    scene.proxy.run_once()
    assert (scene.proxy.command, scene.probe().restarts, spare.alive) == (
        scene.supervisor,
        1,
        False,
    )
