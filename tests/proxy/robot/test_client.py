"""The client proxy follows the membership and routes each service to who can answer it."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from fogft.errors import RosError
from fogft.link.port import Answer, ProbeAnswer
from fogft.model.refusal import Refusal
from fogft.model.replica import Member, Membership, ReplicaId
from fogft.model.spec import HedgingMode, OnTimeout, Part, ServiceSpec
from fogft.model.topic import Origin, TopicSpec
from fogft.model.type_definition import Definition
from fogft.proxy.robot.client import ClientProxy
from fogft.proxy.robot.dispatcher import Dispatcher
from fogft.proxy.robot.proxied_service import HOLD_S
from tests.fakes.proxy import UID, Clock, FakeDialer, FakeNode
from tests.fakes.threads import meanwhile

SET_BOOL = "std_srvs/srv/SetBool"
PAIR = Definition(fields={"message": (("a", "int32"), ("b", "int32"))})
OURS = {SET_BOOL: Definition(fields={"request": (("data", "boolean"),)}), "p/msg/T": PAIR}


def member(slot: int, generation: int = 1, *, port: int = 1, draining: bool = False) -> Member:
    return Member(ReplicaId(UID, slot, generation), f"h{slot}:{port}", draining)


def membership(*members: Member, version: int = 1, epoch: int = 1, uid: str = UID) -> Membership:
    return Membership("pool", uid, epoch, version, members)


class Scene:
    def __init__(self, *names: str, clock: Any = None) -> None:
        self.clock = clock or Clock()
        self.unknown: set[str] = set()  # types that cannot be used here
        self.node = FakeNode()
        self.dialer = FakeDialer()
        self.proxy = ClientProxy(
            UID,
            self.node,
            self.dialer,
            self._dispatcher,
            clock=self.clock,
            define=OURS.__getitem__,
        )
        self.proxy.serve([ServiceSpec(name, SET_BOOL) for name in names or ("/s",)])

    def _dispatcher(self, spec: ServiceSpec, respond: Any, wake: Any) -> Dispatcher:
        if spec.type in self.unknown:
            raise RosError(f"no type `{spec.type}`")
        empty = b"empty" if spec.on_timeout is OnTimeout.EMPTY else None
        return Dispatcher(spec, respond, wake=wake, clock=self.clock, empty_response=empty)

    def follow(self, *members: Member, **options) -> bool:
        return self.proxy.follow(membership(*members, **options))

    def ready(self, *links, service: str = "/s") -> None:
        for link in links:
            link.ready = frozenset({service})
            self.proxy.changed(link)
        self.proxy.run_once(0)

    def ask(self, payload: bytes = b"q", service: str = "/s") -> None:
        self.node.servers[service].on_request(payload, "caller")


def test_one_link_a_member():
    scene = Scene()
    scene.follow(member(0), member(1))
    assert [link.peer.endpoint for link in scene.dialer.links] == ["h0:1", "h1:1"]
    assert scene.dialer.links[1].peer.certificate_name == f"replica.1.1.{UID}"


def test_the_service_is_advertised_once_a_replica_can_answer():
    scene = Scene()
    scene.follow(member(0))
    scene.proxy.run_once(0)
    assert scene.node.servers == {}
    scene.ready(*scene.dialer.links)
    assert list(scene.node.servers) == ["/s"]


def test_a_client_on_another_middleware_is_told(caplog):
    """It would wait for ever, and nothing else would say why."""
    scene = Scene()
    scene.follow(member(0))
    scene.ready(*scene.dialer.links)
    scene.node.servers["/s"].stranger = "a client of `/s` runs on rmw_cyclonedds_cpp"
    for _ in range(3):
        scene.clock.now += 5.0
        scene.proxy.run_once(0)
    assert scene.proxy.report()["services"]["/s"]["trouble"].endswith("rmw_cyclonedds_cpp")
    assert caplog.text.count("service_disturbed") == 1
    scene.node.servers["/s"].stranger = ""
    scene.clock.now += 5.0
    scene.proxy.run_once(0)
    assert scene.proxy.report()["services"]["/s"]["trouble"] == ""


def test_a_request_goes_to_every_ready_replica_and_the_answer_to_the_caller():
    scene = Scene()
    scene.follow(member(0), member(1))
    scene.ready(*scene.dialer.links)
    scene.ask()
    first, second = scene.dialer.links
    scene.proxy.answered(second, second.reply(b"r"))
    scene.proxy.answered(first, first.reply(b"late"))
    assert scene.node.servers["/s"].responses == [("caller", b"r")]


def test_a_replica_that_is_not_ready_gets_nothing():
    scene = Scene()
    scene.follow(member(0), member(1))
    scene.ready(scene.dialer.links[0])
    scene.ask()
    assert [len(link.offered) for link in scene.dialer.links] == [1, 0]


@pytest.mark.parametrize("by", ["member", "link"])
def test_a_draining_replica_is_spared_while_another_can_answer(by):
    scene = Scene()
    scene.follow(member(0, draining=by == "member"), member(1))
    scene.dialer.links[0].leaving = by == "link"
    scene.ready(*scene.dialer.links)
    scene.ask()
    assert [len(link.offered) for link in scene.dialer.links] == [0, 1]


def test_a_draining_replica_is_asked_where_a_quorum_needs_it():
    scene = Scene()
    scene.proxy.serve([ServiceSpec("/s", SET_BOOL, quorum=2)])
    scene.follow(member(0, draining=True), member(1))
    scene.ready(*scene.dialer.links)
    scene.ask()
    assert [len(link.offered) for link in scene.dialer.links] == [1, 1]


def test_a_draining_replica_is_told_to_cancel_too():
    """It may be the one that works on the goal."""
    scene = Scene()
    scene.proxy.serve([ServiceSpec("/s", SET_BOOL, part=Part.CANCEL)])
    scene.follow(member(0, draining=True), member(1))
    scene.ready(*scene.dialer.links)
    scene.ask()
    assert [len(link.offered) for link in scene.dialer.links] == [1, 1]


def test_a_draining_replica_answers_when_it_is_the_last():
    scene = Scene()
    scene.follow(member(0, draining=True))
    scene.ready(*scene.dialer.links)
    scene.ask()
    assert len(scene.dialer.links[0].offered) == 1


def test_a_member_that_left_is_dropped_and_its_requests_move():
    scene = Scene()
    scene.follow(member(0), member(1))
    old, other = scene.dialer.links
    scene.ready(old)
    scene.ask()
    scene.follow(member(1), version=2)
    assert old.closed
    scene.proxy.answered(old, old.refusal(Refusal.LOST))
    scene.ready(other)
    assert old.offered[0][1] == other.offered[0][1]


def test_a_new_endpoint_makes_a_new_link():
    scene = Scene()
    scene.follow(member(0))
    scene.follow(member(0, port=2), version=2)
    assert [link.closed for link in scene.dialer.links] == [True, False]


def test_an_unchanged_member_keeps_its_link():
    scene = Scene()
    scene.follow(member(0))
    scene.follow(member(0), version=2)
    assert len(scene.dialer.links) == 1


@pytest.mark.parametrize(
    "old",
    [
        {"version": 1, "epoch": 2},
        {"version": 9, "epoch": 1},
        {"version": 9, "epoch": 9, "uid": "f" * 16},
    ],
)
def test_an_older_membership_or_another_pools_never_wins(old):
    scene = Scene()
    scene.follow(member(0), version=2, epoch=2)
    assert not scene.follow(member(5), **old)
    assert [link.peer.id.slot for link in scene.dialer.links] == [0]


def test_a_changed_policy_keeps_the_service_advertised_and_its_requests():
    scene = Scene()
    scene.follow(member(0))
    scene.ready(*scene.dialer.links)
    scene.ask()
    scene.proxy.serve([ServiceSpec("/s", SET_BOOL, timeout_s=1.0)])
    scene.proxy.run_once(0)
    link = scene.dialer.links[0]
    scene.proxy.answered(link, link.reply(b"r"))
    assert scene.node.servers["/s"].responses == [("caller", b"r")]
    assert not scene.node.servers["/s"].closed
    assert len(scene.dialer.links) == 1


def test_a_removed_service_is_withdrawn():
    scene = Scene("/s", "/t")
    scene.follow(member(0))
    scene.ready(*scene.dialer.links, service="/t")
    scene.proxy.serve([ServiceSpec("/s", SET_BOOL)])
    assert scene.node.servers["/t"].closed


def test_an_added_service_is_dialled_with_its_own_key():
    scene = Scene("/s")
    scene.follow(member(0))
    scene.proxy.serve([ServiceSpec("/s", SET_BOOL), ServiceSpec("/t", SET_BOOL)])
    assert set(scene.dialer.links[-1].services) == {"/s", "/t"}


def test_an_answer_to_a_service_that_is_no_longer_proxied_does_nothing():
    scene = Scene()
    scene.follow(member(0))
    scene.ready(*scene.dialer.links)
    scene.ask()
    link = scene.dialer.links[0]
    scene.proxy.serve([])
    scene.proxy.answered(link, link.reply(b"r"))
    assert scene.node.servers["/s"].responses == []


def test_all_links_silent_together_is_the_uplink():
    scene = Scene()
    scene.follow(member(0), member(1))
    scene.ready(*scene.dialer.links)
    assert not scene.proxy.links.silent_together
    for link in scene.dialer.links:
        link.ready = frozenset()
    assert scene.proxy.links.silent_together
    assert scene.proxy.report()["uplink_suspected"]


def test_the_report_names_who_answered():
    scene = Scene()
    scene.follow(member(0), member(1))
    scene.ready(*scene.dialer.links)
    scene.ask()
    link = scene.dialer.links[1]
    scene.proxy.answered(link, link.reply(b"r"))
    report = scene.proxy.report()
    assert [entry["won"] for entry in report["links"]] == [0, 1]
    assert report["services"]["/s"]["answered"] == 1


def test_close_closes_every_link():
    scene = Scene()
    scene.follow(member(0), member(1))
    scene.proxy.close()
    assert all(link.closed for link in scene.dialer.links)


def test_a_service_that_ros_refuses_does_not_take_the_others_with_it(caplog):
    scene = Scene("/good", "/bad")
    scene.node.refuses = "/bad"
    scene.follow(member(0))
    for _ in range(3):
        scene.dialer.links[0].ready = frozenset({"/good", "/bad"})
        scene.proxy.changed(scene.dialer.links[0])
        scene.proxy.run_once(0)
    assert list(scene.node.servers) == ["/good"]
    assert caplog.text.count("service_not_advertised") == 1
    scene.node.refuses = ""
    scene.proxy.changed(scene.dialer.links[0])
    scene.proxy.run_once(0)
    assert set(scene.node.servers) == {"/good", "/bad"}


def test_a_proxy_whose_take_loop_ended_says_so_and_does_not_go_on():
    """It would take no request ever again; whoever supervises it starts another."""
    scene = Scene()
    scene.node.alive = False
    with pytest.raises(RosError):
        scene.proxy.run_once(0)


def test_a_signal_that_is_handled_as_the_wait_ends_does_not_make_it_wait_for_ever():
    """On a busy machine SIGTERM was handled so late that nothing ended the wait any more."""
    scene, handled = Scene(clock=time.monotonic), threading.Event()

    def handle(*_: object) -> None:
        time.sleep(0.1)  # past the end of the wait
        handled.set()

    rescue = threading.Timer(10.0, scene.proxy.look_again)  # should it hang
    old = signal.signal(signal.SIGALRM, handle)
    try:
        scene.proxy.run_once(0)
        rescue.start()
        signal.setitimer(signal.ITIMER_REAL, 0.02)
        scene.proxy.run_once(0.05)
        assert rescue.is_alive(), "only the rescue has ended the wait"
    finally:
        signal.signal(signal.SIGALRM, old)
        rescue.cancel()
    assert handled.is_set()


def told(slot: int, kind: str) -> ProbeAnswer:
    types = {SET_BOOL: Definition(fields={"request": (("data", kind),)})}
    return ProbeAnswer(
        slot=slot, generation=1, incarnation="i", ready=frozenset({"/s"}), types=types
    )


def test_a_replica_whose_type_differs_is_not_asked_and_says_which_field():
    scene = Scene()
    scene.follow(member(0), member(1))
    for link, kind in zip(scene.dialer.links, ("boolean", "int64"), strict=True):
        link.told = told(link.peer.id.slot, kind)
    scene.ready(*scene.dialer.links)
    scene.ask()
    assert [len(link.offered) for link in scene.dialer.links] == [1, 0]
    good, bad = scene.proxy.report()["links"]
    assert (good["differs"], good["ready"], bad["differs"], bad["ready"]) == (
        False,
        ["/s"],
        True,
        [],
    )
    assert "field `request.data` is `boolean` here and `int64` on the replica" in bad["detail"]


def test_a_replica_that_offers_the_service_as_another_type_says_so():
    """No type of that name may be known here; the names alone tell."""
    scene = Scene()
    scene.follow(member(0))
    [link] = scene.dialer.links
    offered = {"/s": "a_b/srv/C", "/t": SET_BOOL}
    link.told = replace(told(0, "boolean"), types={}, ready=frozenset(), offered=offered)
    scene.ready(link)
    [report] = scene.proxy.report()["links"]
    assert (report["differing"], report["detail"]) == (
        ["/s"],
        f"`run` offers /s as a_b/srv/C, not as {SET_BOOL}",
    )
    link.told = replace(link.told, ready=frozenset({"/s"}))  # `run` finds out what it offers
    scene.ready(link)
    assert not scene.proxy.report()["links"][0]["differs"]


def test_a_topic_does_not_pass_to_a_replica_that_has_its_fields_in_another_order():
    """Its bytes would be read there as another message."""
    scene, heard = Scene(), []
    end = SimpleNamespace(close=lambda: None, mismatch=str)
    node = SimpleNamespace(subscribe=lambda topic, on_message: heard.append(on_message) or end)
    topic = TopicSpec("/t", "p/msg/T", Origin.ROBOT)
    scene.proxy.pass_topics([topic], node)
    scene.follow(member(0), member(1))
    other = Definition(fields={"message": (("b", "int32"), ("a", "int32"))})
    for link, theirs in zip(scene.dialer.links, (PAIR, other), strict=True):
        types = {"p/msg/T": theirs}
        link.told = replace(told(link.peer.id.slot, "boolean"), types=types, detail="starting")
    scene.ready(*scene.dialer.links, service=topic.key_name)
    heard[0](b"message")
    assert [len(link.offered) for link in scene.dialer.links] == [1, 0]
    bad = scene.proxy.report()["links"][1]
    assert (bad["differing"], bad["differs"]) == ([topic.key_name], False)  # services may answer
    assert bad["detail"] == "starting"
    scene.dialer.links[1].told = replace(scene.dialer.links[1].told, detail="")
    bad = scene.proxy.report()["links"][1]
    assert "the order of fields differs: `message.a` here, `message.b` there" in bad["detail"]


def test_what_a_replica_that_says_it_hangs_has_is_sent_to_another():
    scene = Scene()
    scene.proxy.serve([ServiceSpec("/s", SET_BOOL, hedging=HedgingMode.FAILOVER)])
    scene.follow(member(0), member(1))
    scene.ready(*scene.dialer.links)
    scene.ask()
    first, second = scene.dialer.links
    first.told = replace(told(0, "boolean"), hanging=frozenset({"/s"}))
    scene.ready(first)
    assert [len(link.offered) for link in (first, second)] == [1, 1]
    assert scene.proxy.report()["links"][0]["hanging"] == ["/s"]


def test_where_every_type_differs_nothing_is_advertised():
    scene = Scene()
    scene.follow(member(0))
    scene.dialer.links[0].told = told(0, "int64")
    scene.ready(*scene.dialer.links)
    assert scene.node.servers == {}


def test_a_service_is_withdrawn_when_nobody_can_answer_and_offered_again():
    scene = Scene()
    scene.follow(member(0))
    [link] = scene.dialer.links
    scene.ready(link)
    first = scene.node.servers["/s"]
    link.ready = frozenset()
    scene.proxy.changed(link)
    scene.proxy.run_once(0)
    assert not first.closed
    scene.clock.now += HOLD_S
    scene.proxy.run_once(0)
    assert first.closed
    scene.ready(link)
    assert scene.node.servers["/s"] is not first
    scene.ask()
    scene.proxy.answered(link, link.reply(b"r"))
    assert scene.node.servers["/s"].responses == [("caller", b"r")]


def test_a_service_is_not_withdrawn_under_a_request_that_waits():
    scene = Scene()
    scene.follow(member(0))
    [link] = scene.dialer.links
    scene.ready(link)
    scene.ask()
    link.ready = frozenset()
    scene.proxy.changed(link)
    scene.proxy.run_once(0)
    scene.clock.now += HOLD_S
    scene.proxy.run_once(0)
    assert not scene.node.servers["/s"].closed
    scene.proxy.answered(link, link.reply(b"r"))
    assert scene.node.servers["/s"].responses == [("caller", b"r")]


def test_topics_are_told_and_answered_while_they_change():
    """By a scrape's thread and by the links': neither may fail over a new pool file."""
    scene = Scene()
    scene.follow(member(0))
    (link,) = scene.dialer.links
    end = SimpleNamespace(close=lambda: None)
    node = SimpleNamespace(publisher=lambda topic: end, subscribe=lambda topic, heard: end)
    topics = [TopicSpec(f"/{number}", "p/msg/T", Origin.ROBOT) for number in range(20)]

    def change() -> None:
        for number in range(60):
            scene.proxy.pass_topics(topics if number % 2 else (), node)

    def look() -> None:
        scene.proxy.answered(link, Answer(b"i" * 16, service=topics[0].key_name))
        scene.proxy.report()

    meanwhile(change, look)
    assert scene.proxy.report()["topics"].keys() == {topic.name for topic in topics}


def test_a_service_that_cannot_be_proxied_keeps_no_other_from_changing():
    """A new type that this process cannot load: the rest of the file holds, links included."""
    scene = Scene()
    scene.follow(member(0))
    scene.ready(*scene.dialer.links)
    scene.unknown = {"x/srv/Missing"}
    wanted = [ServiceSpec(name, SET_BOOL) for name in ("/s", "/new", "/later")]
    with pytest.raises(RosError, match="no type `x/srv/Missing`"):
        scene.proxy.serve([*wanted[:2], ServiceSpec("/bad", "x/srv/Missing"), wanted[2]])
    assert set(scene.dialer.links[-1].services) == {"/s", "/new", "/later"}
    scene.ready(scene.dialer.links[-1], service="/new")
    assert "/new" in scene.node.servers
    scene.unknown = set()
    scene.proxy.serve([*wanted, ServiceSpec("/bad", "x/srv/Missing")])
    assert "/bad" in scene.dialer.links[-1].services


def test_a_service_that_cannot_change_stays_as_it_was():
    """And can be changed back, which changes nothing."""
    scene = Scene()
    scene.follow(member(0))
    scene.ready(*scene.dialer.links)
    scene.unknown = {"x/srv/Missing"}
    before = ServiceSpec("/s", SET_BOOL)
    for specs in ([replace(before, type="x/srv/Missing")], [before]):
        with contextlib.suppress(RosError):
            scene.proxy.serve(specs)
        assert not scene.node.servers["/s"].closed
        scene.ask()
        [link] = scene.dialer.links
        scene.proxy.answered(link, link.reply(b"r"))
    assert scene.node.servers["/s"].responses == [("caller", b"r")] * 2


def test_a_request_whose_service_changes_its_kind_ends_as_at_its_deadline():
    """Its answers would come for another dispatcher: nobody would hear of it any more."""
    scene = Scene("/other")
    base = ServiceSpec("/s", SET_BOOL, on_timeout=OnTimeout.EMPTY)
    scene.proxy.serve([base])
    scene.follow(member(0), member(1))
    scene.ready(*scene.dialer.links)
    scene.ask()
    server = scene.node.servers["/s"]
    scene.proxy.serve([replace(base, quorum=2)])
    assert server.responses == [("caller", b"empty")]


def test_the_requests_of_a_service_that_is_removed_end_as_its_file_says():
    scene = Scene("/t")
    spec = ServiceSpec("/s", SET_BOOL, timeout_s=5.0, on_timeout=OnTimeout.EMPTY)
    scene.proxy.serve([spec])
    scene.follow(member(0))
    scene.ready(*scene.dialer.links)
    scene.ask()
    server, link = scene.node.servers["/s"], scene.dialer.links[-1]
    scene.proxy.serve([])
    assert [payload for _, payload in server.responses] == [b"empty"]
    assert len(link.forgotten) == 1, "replicas stop working on them"
