"""Dispatcher and responder of a stateful service, joined by hand: nothing happens by itself."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from fogft.errors import RosError, Unreadable
from fogft.link.port import Answer
from fogft.model.refusal import Refusal
from fogft.model.spec import OnTimeout, ServiceSpec
from fogft.model.state import StateService, StateSpec
from fogft.ordering.orders import Op, decode, encode, encode_snapshot
from fogft.ordering.peer import Peer
from fogft.proxy.replica.ordered_responder import Clients, OrderedResponder
from fogft.proxy.robot.dispatcher import Dispatcher
from fogft.proxy.robot.order_mark import OrderMark
from fogft.proxy.robot.service_order import ServiceOrder
from fogft.requests.load import Handling
from tests.fakes.proxy import UID, Clock, FakeClient, FakeLink

STATE = StateSpec(StateService("/g", "p/srv/G", "d"), StateService("/s", "p/srv/S", "d"))


class Plain:
    """A state that travels as it is."""

    def snapshot_request(self):
        return b"get"

    def read_snapshot(self, response):
        if response == b"no":
            raise RosError("it will not")
        return response

    def restore_request(self, state):
        return b"set " + state

    def check_restored(self, response):
        if response != b"ok":
            raise RosError("it would not")


class Incoming:
    """An order that goes back where it came from."""

    def __init__(self, scene, link, request_id, payload, robot="r"):
        self.scene, self.link = scene, link
        self.request_id, self.payload, self.robot = request_id, payload, robot
        self.service, self.remaining_s, self.handling = "/s", 60.0, Handling.NORMAL

    def reply(self, payload, **_):
        self.scene.answers.append((self.link, Answer(self.request_id, payload=payload)))

    def refuse(self, reason, detail="", **_):
        answer = Answer(self.request_id, refusal=reason, detail=detail)
        self.scene.answers.append((self.link, answer))


class Scene:
    """One dispatcher, its links, a responder behind each, and their three clients."""

    def __init__(self, folder, replicas=2, **spec):
        self.clock = Clock()
        self.rounds = 50
        self.responses = []
        self.answers = []
        self.spec = ServiceSpec("/s", "p/srv/S", timeout_s=5.0, state=STATE, **spec)
        self.folder = folder
        self.links = [FakeLink(slot) for slot in range(replicas)]
        self.clients = [Clients(FakeClient(), FakeClient(), FakeClient()) for _ in self.links]
        self.responders = [OrderedResponder("/s", Plain(), self.clock) for _ in self.links]
        for link, responder, clients in zip(self.links, self.responders, self.clients, strict=True):
            link.ready = frozenset(["/other"])
            responder.use(clients)
            responder.tick(alive=True)
        self.dispatcher = self.start()

    def start(self, *, held=False):
        mark = OrderMark(self.folder / "mark", UID)
        order = ServiceOrder("/s", mark, clock=self.clock, held=held)
        dispatcher = Dispatcher(
            self.spec,
            lambda handle, payload: self.responses.append((handle, payload)),
            decide=order,
            empty_response=b"empty",
            clock=self.clock,
            id_of=lambda service, handle: f"{handle}".encode().ljust(16),
        )
        dispatcher.route(self.links)
        return dispatcher

    def run(self, *slots):
        """Carry orders and answers until nothing moves; services stay as they are."""
        for _ in range(self.rounds):
            for slot in slots or range(len(self.links)):
                offered, self.links[slot].offered = self.links[slot].offered, []
                for _, request, payload, _ in offered:
                    incoming = Incoming(self, self.links[slot], request, payload)
                    self.responders[slot].request(incoming)
            answers, self.answers = self.answers, []
            for link, answer in answers:
                self.dispatcher.answered(link, answer)
            self.clock.now += 0.04
            self.dispatcher.tick()

    def serve(self, slot, answer):
        """Let a replica's service answer the oldest call that it has."""
        payload, on_response = self.clients[slot].service.calls.pop(0)
        on_response(answer)
        return payload


@pytest.fixture
def scene(tmp_path):
    return Scene(tmp_path)


def test_the_first_answer_is_returned_and_the_others_apply_all_the_same(scene):
    scene.run()
    scene.dispatcher.submit(b"q1", "h1")
    scene.run()
    assert scene.serve(1, b"a1") == b"q1"
    scene.run()
    assert scene.responses == [("h1", b"a1")]
    assert scene.serve(0, b"other") == b"q1"
    scene.run()
    assert scene.responses == [("h1", b"a1")]
    assert scene.dispatcher.report()["late"] == 1


def test_a_service_is_given_nothing_until_it_has_found_us(scene):
    """Its response would be lost, and the replica would wait for it for ever."""
    scene.clients[1].restore.known = False
    scene.responders[1].tick(alive=True)
    scene.run()
    scene.dispatcher.submit(b"q1", "h1")
    scene.run()
    assert [len(clients.service.calls) for clients in scene.clients] == [1, 0]
    assert not scene.responders[1].ready
    scene.clients[1].restore.known = True
    scene.responders[1].tick(alive=True)
    scene.run()
    assert scene.serve(1, b"a1") == b"q1"


def test_whoever_repeats_an_order_is_held_without_its_bytes(scene):
    scene.run()
    scene.dispatcher.submit(b"q1", "h1")
    [order] = [one for one in scene.links[0].offered if decode(one[1])[0] is Op.APPLY]
    copies = [Incoming(scene, scene.links[0], order[1], bytes(1 << 20)) for _ in range(3)]
    scene.run()
    for copy in copies:
        scene.responders[0].request(copy)
    assert [copy.payload for copy in copies] == [b"", b"", b""]
    assert scene.serve(0, b"a1") == b"q1"


def test_a_service_is_given_one_request_at_a_time(scene):
    scene.run()
    for i in range(5):
        scene.dispatcher.submit(b"q%d" % i, i)
    scene.run()
    for i in range(5):
        assert len(scene.clients[0].service.calls) == 1
        assert scene.serve(0, b"a%d" % i) == b"q%d" % i
    scene.run()
    assert scene.responses == [(i, b"a%d" % i) for i in range(5)]


@pytest.mark.parametrize("known", [True, False])
def test_another_proxy_orders_what_was_not_taken_and_nothing_twice(scene, known):
    """Both hear all; where it is not known what the first has taken, all that waited is lost."""
    scene.run()
    scene.rounds = 8  # what is held does not wait for ever
    first, second = scene.dispatcher, scene.start(held=True)
    assert second.able
    first.taken = []
    for i in range(3):
        first.takes_no_more = i == 2
        first.submit(b"q%d" % i, i)
        second.submit(b"q%d" % i, i)
        scene.run()
    for i in range(2):
        assert scene.serve(0, b"a%d" % i) == b"q%d" % i
        assert scene.serve(1, b"a%d" % i) == b"q%d" % i
        scene.run()
    taken = first.hold()
    assert len(taken) == 2
    scene.dispatcher = second
    second.take_over(taken if known else None)
    scene.rounds = 25
    scene.run()
    assert len(scene.clients[1].service.calls) == known  # the other is asked for its state
    second.submit(b"q3", 3)
    if known:
        assert scene.serve(1, b"a2") == b"q2"
    scene.run()
    assert scene.serve(1, b"a3") == b"q3"
    scene.run()
    expected = [0, 1, 2, 3] if known else [0, 1, 3]
    assert scene.responses == [(i, b"a%d" % i) for i in expected]


def test_numbers_of_a_term_that_another_has_ended_are_given_anew(scene):
    """What waited for its answer has none, and does not get another's."""
    scene.run()
    scene.rounds = 12
    first = scene.dispatcher
    scene.dispatcher = scene.start()
    scene.run()  # a term of another's, of which the first does not know
    scene.dispatcher = first
    for i in range(2):
        first.submit(b"q%d" % i, i)
        scene.run()
    scene.clock.now += 10.0
    first.tick()
    assert first.waiting == 0
    assert scene.responses == []


def test_a_request_that_comes_as_its_proxy_stops_ordering_is_ordered_by_one_of_both(
    scene, monkeypatch
):
    """The other one would leave to the first what that is said to have taken."""
    scene.run()
    first, second = scene.dispatcher, scene.start(held=True)
    first.taken, told = [], []

    def stops(clock):
        """The main thread does, while another one takes a request."""
        monkeypatch.undo()
        first.takes_no_more = True
        told.extend(first.hold())
        return clock.now

    monkeypatch.setattr(Clock, "__call__", stops)
    first.submit(b"q", 0)
    second.submit(b"q", 0)
    scene.dispatcher = second
    second.take_over(told)
    scene.run()
    assert scene.serve(1, b"a") == b"q"  # the other is asked for its state
    scene.run()
    assert scene.responses == [(0, b"a")]


def test_whether_it_can_answer_is_asked_while_another_thread_begins_a_term(scene, monkeypatch):
    """Where a request comes in, or an answer does: the proxy's own thread asks, and must go on."""
    scene.run()
    first = scene.dispatcher
    scene.dispatcher = scene.start()
    scene.run()  # a term of another's, of which the first does not know
    first.submit(b"q0", 0)
    for link, responder in zip(scene.links, scene.responders, strict=True):
        offered, link.offered = link.offered, []
        for _, request, payload, _ in offered:
            responder.request(Incoming(scene, link, request, payload))
    for link, answer in scene.answers:
        first.answered(link, answer)
    begun, asked, over = threading.Event(), threading.Event(), threading.Event()

    class Seen(Peer):
        def __init__(self):
            super().__init__()
            if begun.is_set():  # of the second replica: the first is known
                asked.wait(0.2)
            begun.set()

        @property
        def joined(self):
            asked.set()
            over.wait(0.2)
            return False

    monkeypatch.setattr("fogft.ordering.sequencer.Peer", Seen)

    def take():
        first.submit(b"q1", 1)
        over.set()

    with ThreadPoolExecutor(1) as other:
        taking = other.submit(take)
        assert begun.wait(10.0)
        assert not first.able
        taking.result()


@pytest.mark.parametrize("waits", [True, False])
def test_a_request_over_which_every_service_dies_ends_as_poison(tmp_path, waits, caplog):
    """Its caller is told what is set for a deadline, if it waits still; the next is applied."""
    scene = Scene(tmp_path, on_timeout=OnTimeout.EMPTY)
    scene.run()
    scene.rounds = 8  # so that it does not expire
    scene.dispatcher.submit(b"kills", "h1")
    scene.run()
    if not waits:
        scene.clock.now += 6.0
        scene.dispatcher.tick()
    for responder, clients in zip(scene.responders, scene.clients, strict=True):
        assert [payload for payload, _ in clients.service.calls] == [b"kills"]
        clients.service.calls.clear()
        responder.crashed()
        responder.use(clients)
        scene.run()
        responder.tick(alive=True)
    assert scene.responses == [("h1", b"empty")]
    count = scene.dispatcher.report()
    assert (count["poison"], count["empty"], count["pending"]) == (waits, not waits, 0)
    assert "request_poison service=/s" in caplog.text
    scene.dispatcher.submit(b"q2", "h2")
    scene.run()
    assert any(clients.service.calls for clients in scene.clients)


def test_requests_wait_until_a_replica_has_joined(tmp_path):
    scene = Scene(tmp_path, replicas=1)
    scene.clients[0].restore.there = False
    scene.responders[0].tick(alive=True)
    scene.dispatcher.submit(b"q", "h")
    scene.run()
    assert not scene.dispatcher.able
    assert not scene.clients[0].service.calls
    scene.clients[0].restore.there = True
    scene.responders[0].tick(alive=True)
    scene.run()
    assert scene.serve(0, b"a") == b"q"


def test_a_new_replica_is_restored_before_it_is_ready(scene):
    scene.run(0)
    for i in range(3):
        scene.dispatcher.submit(b"q%d" % i, i)
        scene.run(0)
        scene.serve(0, b"a%d" % i)
        scene.run(0)
    restarted = scene.dispatcher  # a proxy that knows no earlier requests
    scene.dispatcher = scene.start()
    del restarted
    scene.run()
    assert not scene.responders[1].ready
    _, snapshot_came = scene.clients[0].snapshot.calls.pop(0)
    snapshot_came(b"STATE")
    scene.run()
    assert not scene.responders[1].ready
    ((payload, restored),) = scene.clients[1].restore.calls
    assert payload == b"set STATE"
    restored(b"ok")
    scene.run()
    assert scene.responders[1].ready
    assert not scene.clients[1].service.calls, "nothing is applied twice"


def test_a_restore_that_is_never_answered_is_told_and_given_up(scene):
    scene.run()
    _, epoch = scene.dispatcher.submit(b"q", "h"), decode(scene.links[0].offered[-1][1])[1]
    late = Incoming(scene, scene.links[1], encode(Op.RESTORE, epoch, 9), encode_snapshot(9, b"s"))
    scene.responders[1].request(late)
    scene.clock.now += 301.0
    scene.responders[1].tick(alive=True)
    assert "the restore of `/s` failed: no answer for 301 s" in scene.responders[1].detail


def test_a_failed_restore_is_told_and_tried_again(scene):
    scene.run(0)
    scene.dispatcher.submit(b"q", "h")
    scene.run(0)
    scene.serve(0, b"a")
    scene.run(0)
    scene.dispatcher = scene.start()
    scene.run()
    scene.clients[0].snapshot.calls.pop(0)[1](b"STATE")
    scene.run()
    scene.clients[1].restore.calls.pop(0)[1](b"bad")
    assert "it would not" in scene.responders[1].detail
    assert not scene.responders[1].ready
    scene.run()
    scene.clients[1].restore.calls.pop(0)[1](b"ok")
    scene.run()
    assert scene.responders[1].ready
    assert scene.responders[1].detail == ""


def test_it_knows_whether_the_services_for_its_state_are_there(scene):
    """A typo in their names would else be a state that never becomes the current one."""
    assert scene.responders[1].complete
    scene.clients[1].restore.there = False
    assert not scene.responders[1].complete
    scene.responders[1].use(None)
    assert scene.responders[1].complete


def test_a_crashed_service_does_not_answer_from_its_first_state(scene):
    """Its command was started again: it is given requests only after it has been restored."""
    scene.run()
    scene.dispatcher.submit(b"q1", "h1")
    scene.run()
    scene.serve(0, b"a1")
    scene.serve(1, b"a1")
    scene.run()
    scene.responders[1].crashed()
    scene.responders[1].use(scene.clients[1])
    scene.responders[1].tick(alive=True)
    assert not scene.responders[1].ready
    scene.dispatcher.submit(b"q2", "h2")
    scene.run(1)
    # The log still has everything from the start: it is replayed in order.
    assert [scene.serve(1, b"a%d" % i) for i in (1, 2)] == [b"q1", b"q2"]


def test_what_a_crash_overtakes_is_not_passed_on_to_the_service_that_starts_anew(
    scene, monkeypatch
):
    """It would apply the request from its first state, and later once more in its turn."""
    scene.run()
    for i in range(2):
        scene.dispatcher.submit(b"q%d" % i, i)
    scene.run()
    responder, clients = scene.responders[0], scene.clients[0]
    reply = Incoming.reply

    def dies(incoming, payload, **_):
        """The main thread sees it while this one has yet to pass on what is next."""
        monkeypatch.undo()
        reply(incoming, payload)
        responder.crashed()
        responder.use(None)

    monkeypatch.setattr(Incoming, "reply", dies)
    assert scene.serve(0, b"a0") == b"q0"
    responder.use(clients)
    for _ in range(2):
        responder.tick(alive=True)
    assert clients.service.calls == []
    scene.run()
    assert [payload for payload, _ in clients.service.calls] == [b"q0"]


def test_a_request_that_ros_refuses_for_now_is_passed_on_later(scene):
    scene.run()
    scene.clients[0].service.broken = RosError("its queue is full")
    scene.dispatcher.submit(b"q", "h")
    scene.run()
    scene.clients[0].service.broken = None
    assert not scene.clients[0].service.calls
    scene.responders[0].tick(alive=True)
    assert scene.serve(0, b"a") == b"q"


def test_an_unreadable_request_counts_as_applied_and_holds_nobody_up(scene):
    scene.run()
    for clients in scene.clients:
        clients.service.broken = Unreadable("no such message")
    scene.dispatcher.submit(b"bad", "h1")
    scene.run()
    for clients in scene.clients:
        clients.service.broken = None
    scene.dispatcher.submit(b"good", "h2")
    scene.run()
    assert scene.serve(0, b"a") == b"good"
    scene.run()
    assert scene.responses == [("h2", b"a")]


@pytest.mark.parametrize("on_timeout", list(OnTimeout)[:2])
def test_at_the_deadline_the_policy_answers_and_a_late_answer_does_not(tmp_path, on_timeout):
    scene = Scene(tmp_path, on_timeout=on_timeout)
    scene.run()
    scene.dispatcher.submit(b"q", "h")
    scene.run()
    scene.clock.now += 5.0
    scene.dispatcher.tick()
    empty = on_timeout is OnTimeout.EMPTY
    assert scene.responses == ([("h", b"empty")] if empty else [])
    scene.serve(0, b"late")
    scene.run()
    assert len(scene.responses) == empty
    report = scene.dispatcher.report()
    assert (report["silent"], report["empty"], report["pending"]) == (not empty, empty, 0)


def test_a_lost_link_does_not_apply_a_request_twice(scene):
    """The order is ended as lost while the replica works on it; it is recalled, not repeated."""
    scene.run()
    scene.dispatcher.submit(b"q", "h")
    for slot, link in enumerate(scene.links):
        for _, request, payload, _ in link.offered:
            scene.responders[slot].request(Incoming(scene, link, request, payload))
            scene.dispatcher.answered(link, Answer(request, refusal=Refusal.LOST))
        link.offered = []
    scene.serve(0, b"a")
    scene.answers.clear()
    scene.run()
    assert scene.responses == [("h", b"a")]
    assert not scene.clients[0].service.calls


def test_an_order_of_another_robot_is_refused(scene):
    scene.run()
    other = Scene(scene.folder / "other", replicas=2)
    other.responders, other.clients = scene.responders, scene.clients
    for link in other.links:
        offered, link.offered = link.offered, []
        for _, request, payload, _ in offered:
            slot = link.peer.id.slot
            scene.responders[slot].request(Incoming(other, link, request, payload, robot="x"))
    for link, answer in other.answers:
        other.dispatcher.answered(link, answer)
    other.dispatcher.tick()
    assert "`r`" in other.dispatcher.report()["order"]["trouble"]
    assert scene.dispatcher.able


def test_two_proxies_with_one_certificate_say_why_they_answer_nothing(tmp_path):
    scene, twin = Scene(tmp_path, replicas=1), Scene(tmp_path / "twin", replicas=1)
    twin.responders, twin.clients = scene.responders, scene.clients
    scene.rounds = twin.rounds = 5
    for _ in range(20):
        scene.run()
        twin.run()
    for one in (scene, twin):
        assert "this robot's certificate" in one.dispatcher.report()["order"]["trouble"]
    while calls := scene.clients[0].snapshot.calls:
        calls.pop()[1](b"state")
        scene.run()
    assert scene.dispatcher.able
    assert not scene.dispatcher.report()["order"]["trouble"], "the other one has ended"
    scene.dispatcher.submit(b"q", "h")
    scene.run()
    scene.serve(0, b"a")
    scene.run()
    assert scene.responses == [("h", b"a")]


@pytest.mark.parametrize("op", [op for op in Op if op is not Op.CLAIM])
def test_who_knows_the_term_of_another_robot_can_neither_order_nor_read(scene, op):
    scene.run()
    scene.dispatcher.submit(b"secret", "h")
    _, epoch, first = decode(scene.links[0].offered[-1][1])
    scene.run()
    calls = len(scene.clients[0].service.calls)
    for index in (first, first + 1):
        eves = Incoming(scene, scene.links[0], encode(op, epoch, index), b"evil", robot="x")
        scene.responders[0].request(eves)
        assert scene.answers[-1][1].refusal == Refusal.HELD
    assert len(scene.clients[0].service.calls) == calls


def test_noise_is_refused(scene):
    incoming = Incoming(scene, scene.links[0], b"\xff" * 16, b"q")
    scene.responders[0].request(incoming)
    assert scene.answers[-1][1].refusal == Refusal.MALFORMED


def test_a_service_that_answers_nothing_any_more_hangs_and_is_stuck_in_the_end(tmp_path):
    """As a plain one: after times of what it took before, and never within a caller's time."""
    scene = Scene(tmp_path, replicas=1)
    [responder] = scene.responders
    scene.run()
    scene.dispatcher.submit(b"q", 0)
    scene.run()
    scene.clock.now += 3600.0
    assert responder.quiet_s() == 0.0, "what never answered may still be loading"
    scene.clock.now -= 3600.0 - 0.5
    scene.serve(0, b"r")
    scene.run()
    assert responder.quiet_s() == 0.0
    scene.dispatcher.submit(b"q", 1)
    scene.run()
    scene.clock.now += 30.0
    assert responder.quiet_s() > 30.0
    assert responder.quiet_s(stuck=True) == 0.0
    scene.clock.now += 60.0
    assert responder.quiet_s(stuck=True) > 60.0
    responder.crashed()
    assert responder.quiet_s() == responder.quiet_s(stuck=True) == 0.0
    responder.tick(alive=True)
    scene.run()
    scene.clock.now += 3600.0
    assert responder.quiet_s(stuck=True) == 0.0, "of a new process nothing is known"
