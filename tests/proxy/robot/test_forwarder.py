"""What a gateway does with a request, step by step, on a clock that moves when told."""

from __future__ import annotations

import pytest

from fogft.link.port import Answer, GatewayView, LinkStatus, ProbeAnswer
from fogft.model.refusal import Refusal
from fogft.model.replica import LinkState, ReplicaId
from fogft.model.spec import ServiceSpec
from fogft.proxy.gateway.gateway import UNREADY_S, Forwarder
from fogft.proxy.robot.dispatcher import Dispatcher
from fogft.proxy.robot.links import best_of, seen_through
from fogft.requests.load import Handling
from tests.fakes.proxy import UID, Clock, FakeIncoming, FakeLink
from tests.fakes.threads import meanwhile

READY = frozenset({"/s"})


def refused(reason: str) -> str:
    return f"refused {reason}"


class Scene:
    """A forwarder over a real dispatcher with two links."""

    def __init__(self, **given) -> None:
        self.clock = Clock()
        self.forwarder = type("Bounded", (Forwarder,), given)(clock=self.clock)
        self.dispatcher = Dispatcher(
            ServiceSpec("/s", "std_srvs/srv/SetBool"),
            self.forwarder.respond,
            clock=self.clock,
            poisoned=self.forwarder.poisoned,
        )
        self.forwarder.dispatchers["/s"] = self.dispatcher
        self.links = [FakeLink(0), FakeLink(1)]
        for link in self.links:
            link.ready = READY
        self.dispatcher.route(self.links)
        self.forwarder.tick(READY)

    def request(self, number: int = 1, **given) -> FakeIncoming:
        incoming = FakeIncoming(bytes([number]) * 16, **given)
        self.forwarder.request(incoming)
        self.pass_on()
        return incoming

    def pass_on(self) -> None:
        """Do what the forwarder's thread does, here."""
        self.forwarder.queue.put(None)
        self.forwarder.pass_on()

    def answer(self, slot: int, payload: bytes) -> None:
        link = self.links[slot]
        self.dispatcher.answered(link, link.reply(payload))

    def crash(self, slot: int, id: bytes) -> None:
        self.dispatcher.answered(
            self.links[slot], Answer(id, refusal=Refusal.CRASHED, service="/s")
        )


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_id_and_payload_pass_unchanged_and_the_time_left_shrinks(scene):
    incoming = FakeIncoming(b"i" * 16, b"asked", remaining_s=3.0)
    scene.forwarder.request(incoming)
    scene.clock.now += 1.0  # it waits for the forwarding thread
    scene.pass_on()
    for link in scene.links:
        assert link.offered == [("/s", b"i" * 16, b"asked", pytest.approx(2.0))]
    scene.answer(1, b"answered")
    assert incoming.outcome == [b"answered"]
    assert scene.links[0].forgotten == [b"i" * 16]
    assert scene.forwarder.in_flight == 0


def test_a_copy_joins_and_a_late_one_gets_the_kept_answer(scene):
    first = scene.request()
    copy = scene.request(robot="another link")
    assert len(scene.links[0].offered) == 1
    scene.answer(0, b"a")
    late = scene.request()
    assert [first.outcome, copy.outcome, late.outcome] == [[b"a"]] * 3
    assert len(scene.links[0].offered) == 1
    assert scene.forwarder.joined == 2


def test_a_kept_answer_is_gone_with_its_deadline(scene):
    scene.request(remaining_s=2.0)
    scene.answer(0, b"a")
    scene.clock.now += 2.1
    scene.forwarder.tick(READY)
    late = scene.request()
    assert late.outcome == [refused(Refusal.FORGOTTEN)]  # it is not run again
    assert len(scene.links[0].offered) == 1


def test_who_gives_up_stops_all_who_work_on_it(scene):
    incoming = scene.request()
    scene.forwarder.cancel([incoming.request_id, b"unknown" + bytes(9)])
    assert [link.forgotten for link in scene.links] == [[incoming.request_id]] * 2
    assert incoming.outcome == [refused(Refusal.CANCELLED)]
    assert scene.dispatcher.report()["cancelled"] == 1
    assert scene.dispatcher.report()["pending"] == 0
    scene.answer(0, b"too late")
    assert incoming.outcome == [refused(Refusal.CANCELLED)]


def test_what_services_died_over_is_refused_as_it_is_given_up_and_when_it_comes_again(scene):
    """So the robot asks nobody else twice, and knows why."""
    killer = scene.request()
    for slot in (0, 1):
        scene.crash(slot, killer.request_id)
        scene.clock.now += 0.1
        scene.dispatcher.tick()
    (alone,) = [slot for slot in (0, 1) if scene.links[slot].handled[-1] is Handling.ALONE]
    scene.crash(alone, killer.request_id)
    assert killer.outcome == [refused(Refusal.CRASHED)]
    asked = [len(link.offered) for link in scene.links]
    assert scene.request().outcome == [refused(Refusal.CRASHED)]
    assert scene.request(2).outcome == []
    assert sum(len(link.offered) for link in scene.links) == sum(asked) + 1
    assert scene.dispatcher.report()["poison"] == 1


def test_a_deadline_ends_it(scene):
    incoming = scene.request(remaining_s=1.0)
    scene.clock.now += 1.1
    scene.forwarder.tick(READY)
    assert incoming.outcome == [refused(Refusal.EXPIRED)]
    assert scene.request(2, remaining_s=0.0).outcome == [refused(Refusal.EXPIRED)]


def test_a_short_deadline_does_not_wait_for_a_long_one_before_it(scene):
    patient, hasty = scene.request(1, remaining_s=60.0), scene.request(2, remaining_s=1.0)
    scene.clock.now += 1.1
    scene.forwarder.tick(READY)
    assert (patient.outcome, hasty.outcome) == ([], [refused(Refusal.EXPIRED)])


def test_with_nobody_behind_it_refuses_and_hands_back_what_it_holds(scene):
    held = scene.request()
    scene.forwarder.tick(frozenset())
    assert held.outcome == []  # a link may come back in a moment
    assert scene.request(2).outcome == [refused(Refusal.NOT_READY)]
    scene.clock.now += UNREADY_S
    scene.forwarder.tick(frozenset())
    assert held.outcome == [refused(Refusal.NOT_READY)]


def test_one_robot_does_not_take_all_the_room():
    scene = Scene(held_limit=4, of_one_limit=2)
    outcomes = [scene.request(n, robot="greedy").outcome for n in range(3)]
    assert outcomes == [[], [], [refused(Refusal.OVERLOADED)]]
    outcomes = [scene.request(10 + n, robot=f"r{n}").outcome for n in range(3)]
    assert outcomes == [[], [], [refused(Refusal.OVERLOADED)]]
    scene.dispatcher.answered(scene.links[0], scene.links[0].reply(b"a", 0))
    assert scene.request(20, robot="greedy").outcome == []


def test_one_robot_s_large_requests_keep_no_other_s_out():
    scene = Scene(held_bytes=100_000)
    eve, ada = (
        [
            scene.request(n, payload=bytes(60_000), robot=robot, remaining_s=1e7)
            for n in (first, first + 1)
        ]
        for first, robot in ((1, "eve"), (3, "ada"))
    )
    full = [refused(Refusal.OVERLOADED)]
    assert [[one.outcome for one in of] for of in (eve, ada)] == [[[], full], [[], full]]


def test_kept_answers_are_bounded_by_bytes():
    scene = Scene(kept_bytes=10)
    for number in range(5):
        scene.request(number)
        scene.answer(0, b"1234")
    assert scene.request(4).outcome == [b"1234"]
    assert scene.request(0).outcome == []


def test_closing_refuses_what_is_under_way(scene):
    incoming = scene.request()
    scene.forwarder.close()
    assert incoming.outcome == [refused(Refusal.LOST)]


def status(state: LinkState, *behind: GatewayView, detail: str = "") -> LinkStatus:
    answer = ProbeAnswer(slot=1, generation=1, incarnation="x", behind=behind)
    return LinkStatus(state, answer, 0.5, 3.0, 0.01, 0, 0, detail)


def test_replicas_are_seen_through_a_gateway_as_if_linked():
    up = GatewayView(slot=0, generation=1, state=LinkState.UP, ready=READY, rtt_s=0.02)
    (seen,) = seen_through(status(LinkState.UP, up), "edge")
    assert (seen["state"], seen["ready"], seen["through"]) == ("up", ["/s"], "edge")
    assert seen["rtt_s"] == pytest.approx(0.03)
    (seen,) = seen_through(status(LinkState.SUSPECT, up, detail="silent"), "edge")
    assert (seen["state"], seen["ready"]) == ("suspect", [])
    assert seen["silent_for_s"] == 3.0
    assert "edge" in seen["detail"]


def test_the_best_sight_of_a_replica_counts():
    up = GatewayView(slot=0, generation=1, state=LinkState.UP, ready=READY)
    lost = GatewayView(slot=0, generation=1, state=LinkState.SUSPECT)
    other = GatewayView(slot=1, generation=2, state=LinkState.CONNECTING)
    reports = [
        *seen_through(status(LinkState.UP, lost, other), "one"),
        *seen_through(status(LinkState.UP, up), "two"),
    ]
    found = best_of(reports)
    assert [(r["slot"], r["state"], r["through"]) for r in found] == [
        (0, "up", "two"),
        (1, "connecting", "one"),
    ]
    assert ReplicaId(UID, found[1]["slot"], found[1]["generation"]).short == "1.2"


def test_its_numbers_are_told_while_the_first_are_refused(scene):
    """Its own thread writes them into a file, and probes ask for them: neither may fail over it."""
    for number in range(30):
        forwarder = Forwarder()
        forwarder.tick(READY)
        forwarder.dispatchers["/s"] = scene.dispatcher
        asked = [
            FakeIncoming(b"0" * 16, remaining_s=0.0),
            FakeIncoming(b"1" * 16, service="/unknown"),
            FakeIncoming(b"2" * 16),
        ]

        def refuse(forwarder=forwarder, asked=asked):
            forwarder.poisoned(b"2" * 16)
            for incoming in asked:
                forwarder.request(incoming)

        meanwhile(refuse, lambda forwarder=forwarder: (forwarder.work(), forwarder.report()))
        assert sum(forwarder.report()["refused"].values()) == len(asked), number
