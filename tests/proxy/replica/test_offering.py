"""A replica without listed services takes up what its command offers, and tells once settled."""

from __future__ import annotations

from fogft.link.port import Probe
from fogft.model import names
from fogft.model.replica import ReplicaId
from fogft.model.spec import ServiceSpec
from fogft.model.type_definition import Definition
from fogft.proxy.replica.offering import LOOK_EVERY_S, SETTLED_S, Offering
from fogft.proxy.replica.server import ServerProxy
from tests.fakes.proxy import UID, Clock, FakeIncoming, FakeListener, FakeNode, FakeSupervisor

SET_BOOL = "std_srvs/srv/SetBool"


class Scene:
    def __init__(self, *services: ServiceSpec, graph: dict[str, str] | None = None) -> None:
        self.clock, self.listener = Clock(), FakeListener()
        self.supervisor, self.node = FakeSupervisor(), FakeNode()
        self.node.graph = graph or {}
        self.proxy = ServerProxy(
            ReplicaId(UID, 2, 3),
            services,
            self.listener,
            lambda: self.node,
            self.supervisor,  # type: ignore[arg-type]
            define=lambda name: Definition(hash=name),
            clock=self.clock,
        )
        self.proxy.start()

    def look(self) -> None:
        self.clock.now += LOOK_EVERY_S
        self.proxy.run_once()

    def probe(self):
        return self.listener.on_probe(Probe("robot", True))


def test_what_run_offers_is_taken_up_and_answered():
    scene = Scene(graph={"/arm/plan": SET_BOOL})
    scene.look()
    assert scene.probe().ready == {"/arm/plan"}
    key = names.service_key(UID, 2, "/arm/plan", SET_BOOL)
    assert scene.listener.services == {"/arm/plan": key}
    incoming = FakeIncoming(b"a" * 16, service="/arm/plan")
    scene.listener.on_request(incoming)
    scene.node.clients["/arm/plan"].calls[0][1](b"answer")
    assert incoming.outcome == [b"answer"]


def test_it_is_told_once_nothing_has_changed_for_a_while():
    """A command that starts three nodes is not told node by node."""
    scene = Scene(graph={"/a": SET_BOOL})
    scene.look()
    assert scene.probe().offered == {}
    scene.node.graph["/b"] = SET_BOOL
    scene.clock.now += SETTLED_S - LOOK_EVERY_S
    scene.look()
    assert scene.probe().offered == {}
    scene.clock.now += SETTLED_S
    assert scene.probe().offered == {"/a": SET_BOOL, "/b": SET_BOOL}


def test_nothing_is_told_while_nothing_is_offered():
    scene = Scene()
    scene.look()
    answer = scene.probe()
    assert (answer.ready, answer.detail) == (frozenset(), "`run` offers no service yet")


def test_after_a_death_it_is_told_anew():
    """What the dead command offered is not what the next one offers."""
    scene = Scene(graph={"/a": SET_BOOL})
    scene.look()
    scene.clock.now += SETTLED_S
    assert scene.probe().offered
    scene.supervisor.alive = False
    scene.supervisor.poll = lambda **_: True  # type: ignore[method-assign]
    scene.look()
    assert scene.probe().offered == {}


def test_listed_services_are_all_there_is():
    scene = Scene(ServiceSpec("/s", SET_BOOL), graph={"/s": SET_BOOL, "/more": SET_BOOL})
    scene.look()
    scene.clock.now += SETTLED_S
    assert scene.probe().offered == {}
    assert set(scene.listener.services) == {"/s"}


def test_a_replica_that_offers_other_names_lists_them():
    scene = Scene(ServiceSpec("/s", SET_BOOL), graph={"/arm/s": SET_BOOL})
    scene.node.clients["/s"].there = False
    scene.look()
    assert scene.probe().detail == (
        "`run` does not offer /s yet; it offers /arm/s (std_srvs/srv/SetBool)"
    )


def test_a_service_that_is_there_and_cannot_be_called_is_not_said_to_be_missing():
    """As one with the quality of service of sensor data."""
    scene = Scene(ServiceSpec("/s", SET_BOOL), graph={"/s": SET_BOOL})
    scene.node.clients["/s"].there = False
    scene.look()
    assert "cannot be called" not in scene.probe().detail, "it has only just been found"
    scene.clock.now += SETTLED_S
    assert "`run` offers /s, but it cannot be called" in scene.probe().detail


def test_a_replica_whose_type_is_another_names_both():
    scene = Scene(ServiceSpec("/s", SET_BOOL), graph={"/arm/s": SET_BOOL, "/s": "a_b/srv/C"})
    scene.node.clients["/s"].there = False
    scene.look()
    assert scene.probe().detail == "`run` offers /s as a_b/srv/C, not as std_srvs/srv/SetBool"
    assert scene.probe().offered == {}
    scene.clock.now += SETTLED_S
    assert scene.probe().offered == {"/s": "a_b/srv/C"}
    scene.proxy.ready = frozenset({"/s"})  # of two that have the name, one has the type
    assert scene.probe().offered == {}
    scene.node.clients["/s"].there = True  # it was mended there, without a restart of `run`
    scene.look()
    scene.look()
    assert scene.probe().offered == {}


def test_a_replica_without_the_type_stays_and_says_so():
    """A VM that is launched again and again would not get the type by that."""
    scene = Scene()
    scene.node.refuses = "/x"
    scene.node.graph = {"/x": "my_msgs/srv/X", "/y": SET_BOOL}
    scene.look()
    answer = scene.probe()
    assert answer.ready == {"/y"}
    assert answer.detail == "its type cannot be loaded"


def test_definitions_are_told_only_where_they_are_asked_for():
    scene = Scene(ServiceSpec("/s", SET_BOOL))
    assert scene.probe().types == {SET_BOOL: Definition(hash=SET_BOOL)}
    assert scene.listener.on_probe(Probe("robot")).types == {}
    topics = Offering((), lambda name: Definition(hash=name), Clock(), ("p/msg/T",))
    assert topics.types() == {"p/msg/T": Definition(hash="p/msg/T")}
