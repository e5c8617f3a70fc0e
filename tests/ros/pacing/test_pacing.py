"""No client gets more responses than an ordinary one keeps, unless it shows that it takes them."""

from __future__ import annotations

import itertools
import math
import random
import threading
import time
from collections import Counter, deque

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.errors import RosError
from fogft.ros.pacing import pace as pacing
from fogft.ros.pacing.pace import (
    EVERY_S,
    PROBED_WINDOW,
    QUEUE,
    WAITING_BYTES_LIMIT,
    WAITING_LIMIT,
    WINDOW,
    WINDOW_LIMIT,
    ClientPace,
    Pace,
    Probing,
)
from fogft.ros.pacing.pacer import Pacer
from fogft.ros.port import NotFoundYet
from tests.fakes.threads import no_more
from tests.fakes.waiting import wait_for
from tests.nightly import by_day


class _NoNodes:
    """Nodes that answer no probes."""

    def __init__(self) -> None:
        self.hidden: set[bytes] = set()  # clients that discovery does not list
        self.looks = 0

    def answers(self, service, client):
        return False

    def found(self, service, clients):
        self.looks += 1
        return set(clients) - self.hidden


UNKNOWN = _NoNodes()


class Probed:
    """An ordinary client whose node answers probes: a turn takes one response, answers one probe.

    A service's responses go into every client's queue, which keeps the last ten.
    """

    def __init__(self, pace: Pace, id: bytes, *, answers_first: bool) -> None:
        self.pace = pace.client(id, 0.0)
        self.pace.probing = Probing.YES
        self.id = id
        self.answers_first = answers_first  # as C++ executors do
        self.queue: deque[tuple[bytes, int]] = deque(maxlen=QUEUE)
        self.probes = 0
        self.answered: set[int] = set()

    def turn(self, now: float) -> None:
        if self.answers_first:
            self.answer(now)
        if self.queue:
            id, number = self.queue.popleft()
            if id == self.id:
                self.answered.add(number)
        if not self.answers_first:
            self.answer(now)

    def answer(self, now: float) -> None:
        if self.probes:
            self.probes -= 1
            self.pace.answered_probe(now)


@given(
    seed=st.integers(0, 2**32),
    counts=st.lists(st.integers(1, by_day(60, at_night=300)), min_size=1, max_size=4),
    answers_first=st.booleans(),
    slow=st.sampled_from([0.0, 0.5, 0.9]),
)
def test_a_client_whose_node_answers_probes_loses_nothing(seed, counts, answers_first, slow):
    """Whatever it asks at once, however slowly it takes, and whoever else calls the service."""
    chance, now, pace = random.Random(seed), 0.0, Pace()
    clients = [
        Probed(pace, bytes([n]) * 16, answers_first=answers_first) for n in range(len(counts))
    ]
    waiting = []
    for client, count in zip(clients, counts, strict=True):
        for number in range(count):
            client.pace.requested(now)
            waiting.append((client, number))
    chance.shuffle(waiting)
    while waiting:
        assert now < 60.0, "what waits is not sent"
        now += 1e-4
        client, number = waiting[0]
        if pace.take(client.pace, now):
            for each in clients:
                each.queue.append((client.id, number))
            waiting.pop(0)
        else:
            for id, other in pace.in_the_way(client.pace, now):
                clients[id[0]].probes += other.probes_due(now, pace.sent)
        if chance.random() >= slow:
            chance.choice(clients).turn(now)
    for client in clients:
        for _ in range(QUEUE):
            client.turn(now)
    assert [len(client.answered) for client in clients] == counts


def test_who_does_not_take_gets_no_more_than_its_queue_holds():
    """It is held up, in a callback of ten seconds: no answer to a probe, no response."""
    pace = Pace()
    client = pace.client(b"c", 0.0)
    client.probing = Probing.YES
    for _ in range(100):
        client.requested(0.0)
    sent = sum(pace.take(client, n / 100) for n in range(1000))
    assert sent == PROBED_WINDOW < QUEUE
    assert client.probes_due(10.0, pace.sent)
    assert not client.probes_due(10.1, pace.sent)
    assert client.probes_due(11.5, pace.sent), "the first were lost"


def test_who_answers_no_probe_holds_up_nobody_else_for_long():
    pace = Pace()
    dead, other = pace.client(b"d", 0.0), pace.client(b"o", 0.0)
    dead.probing = other.probing = Probing.YES
    for client in (dead, other):
        for _ in range(20):
            client.requested(0.0)
    while pace.take(dead, 0.0):
        pass
    assert not pace.take(other, 0.0)
    assert [id for id, _ in pace.in_the_way(other, 0.0)] == [b"d"]
    dead.probes_due(0.0, pace.sent)
    assert not pace.take(other, 0.1)
    assert pace.take(other, 0.3)
    assert not pace.take(dead, 29.0)


def test_a_lone_caller_is_never_probed():
    """Its next request shows that it took the last response."""
    pace = Pace()
    for n in range(1000):
        client = pace.client(b"c", n * 1e-4)
        client.requested(n * 1e-4)
        assert pace.take(client, n * 1e-4)
    assert client.probing is Probing.UNASKED


class Alone:
    """The only client of a service, whose node answers no probes."""

    def __init__(self) -> None:
        self.service = Pace()
        self.client: ClientPace = self.service.client(b"c", 0.0)
        self.client.probing = Probing.NO
        self.requested = self.client.requested

    def take(self, now: float) -> bool:
        return self.service.take(self.client, now)


def test_a_burst_is_answered_a_window_at_once_and_then_one_by_one():
    pace = Alone()
    for n in range(200):
        pace.requested(n * 1e-5)
    now, sent = 0.002, 0
    while sent < 200:
        sent += pace.take(now)
        assert sent <= WINDOW + (now - 0.002) / EVERY_S + 1
        now += 1e-4
    assert now < 200 * EVERY_S


@given(
    bursts=st.lists(st.integers(1, 200), min_size=1, max_size=6),
    pauses=st.sampled_from([0.0, 0.01, 0.3]),
    latency=st.floats(0.002, 0.01),
    spacing=st.floats(2e-5, 2e-4),
)
def test_a_client_that_takes_nothing_while_it_asks_never_overflows(
    bursts, pauses, latency, spacing
):
    """It asks in bursts and takes one a millisecond otherwise; answers come slower than it asks."""
    now, pace, untaken = 0.0, Alone(), 0
    asked: list[float] = []

    def answer(most: int = 1000) -> int:
        sent = 0
        while sent < most and asked and asked[0] + latency <= now and pace.take(now):
            asked.pop(0)
            sent += 1
        return sent

    for burst in bursts:
        for n in range(burst):
            pace.requested(now)
            asked.append(now)
            now += spacing
            if n % 2:
                untaken += answer(1)
            assert untaken <= QUEUE
        while asked or untaken:
            untaken = max(untaken - 1, 0)
            now += 0.001
            untaken += answer()
            assert untaken <= QUEUE
        now += pauses


@pytest.mark.parametrize("at_once", [1, 2, 9, 64])
def test_a_client_that_asks_again_for_each_answer_is_hardly_held_up(at_once):
    """A caller in a closed loop, however fast, waits only until what it has open is usual."""
    now, pace, waits = 0.0, Alone(), 0
    for _ in range(at_once):
        pace.requested(now)
    for _ in range(5000):
        while not pace.take(now):
            waits += 1
            now += EVERY_S
        now += 1e-5
        pace.requested(now)
    assert waits <= at_once


def test_a_client_that_proved_quick_must_prove_it_again_after_a_pause():
    pace = Alone()
    now = 0.0
    for _ in range(1000):
        pace.requested(now)
        assert pace.take(now)
        now += 1e-4
    now += 1.0
    for _ in range(2 * WINDOW_LIMIT):
        pace.requested(now)
    assert sum(pace.take(now) for _ in range(2 * WINDOW_LIMIT)) == WINDOW


def test_a_client_that_asks_more_than_is_answered_is_not_starved():
    """It asks five thousand times a second for long, and takes: that is no burst, but its use."""
    now, pace, sent = 0.0, Alone(), 0
    for n in range(10_000):
        pace.requested(now)
        now += 2e-4
        if n % 5 < 3:  # what the replicas can answer
            sent += pace.take(now)
    assert sent > 5000


class Sent:
    def __init__(self) -> None:
        self.responses: list[tuple[bytes, bytes]] = []
        self.all = threading.Event()
        self.expected = 0

    def __call__(self, handle: bytes, payload: bytes) -> None:
        if payload == b"refused":
            raise RosError("no room")
        self.responses.append((handle, payload))
        if len(self.responses) == self.expected:
            self.all.set()


def handle(client: int, number: int) -> bytes:
    return bytes([client]) * 16 + number.to_bytes(8, "little")


def test_every_response_is_sent_once_and_in_order(monkeypatch):
    monkeypatch.setattr(pacing, "BEHIND_S", math.inf)  # however slow this machine is
    sent = Sent()
    sent.expected = 99
    pacer = Pacer(sent, UNKNOWN, "/s")
    for n in range(100):
        pacer.requested(handle(1, n))
    for n in range(100):
        pacer.respond(handle(1, n), b"refused" if n == 50 else b"%d" % n)
    assert sent.all.wait(30)
    assert sent.responses == [(handle(1, n), b"%d" % n) for n in range(100) if n != 50]
    pacer.close()


def test_who_takes_more_slowly_than_it_asks_gets_the_newest_first():
    """In turn, each would come long after its caller has given up: none would be of use."""
    pace, ages = Pace(), []
    client = pace.client(b"a", 0.0)
    client.probing = Probing.YES
    for step in range(3000):  # it asks ten times a second and takes four
        now = step * 0.05
        if step % 2 == 0:
            client.requested(now)
        answered = step % 2 == 0 and step >= 6  # the service takes 0.3 s
        if answered and (client.waiting or not pace.take(client, now)):
            assert client.hold(now - 0.3, b"", now)
        if step % 5 == 0:
            client.probes_due(now, pace.sent)
            client.answered_probe(now)
            while client.waiting and pace.take(client, now):
                ages.append(now - client.next(now)[0])
    late = ages[len(ages) // 2 :]
    assert len(late) > 200
    assert max(late) < 2.0


@pytest.mark.parametrize(("size", "most"), [(0, WAITING_LIMIT), (1 << 20, 64)])
def test_what_waits_for_one_client_is_bounded(size, most):
    """Beyond that it is sent at once: nothing is kept without end, and nothing is dropped."""
    sent = []
    pacer = Pacer(lambda handle, payload: sent.append(handle), UNKNOWN, "/s", clock=lambda: 0.0)
    payload = bytes(size)
    asked = [handle(0, number) for number in range(WINDOW + most + 100)]
    for one in asked:
        pacer.requested(one)
    for one in asked:
        pacer.respond(one, payload)
    pacer.close()
    assert len(sent) == WINDOW + 100
    assert WAITING_BYTES_LIMIT == 64 << 20


def test_one_clients_burst_does_not_hold_up_another():
    sent = Sent()
    pacer = Pacer(sent, UNKNOWN, "/s", clock=lambda: 0.0)
    for n in range(100):
        pacer.requested(handle(1, n))
        pacer.respond(handle(1, n), b"")
    pacer.requested(handle(2, 0))
    pacer.respond(handle(2, 0), b"")
    assert sent.responses[-1][0] == handle(2, 0)
    pacer.close()


def test_a_client_whose_node_is_found_late_is_not_paced_by_time():
    """The way to what would answer a probe is told after whose client it is."""
    now, sent, probed, looks = [0.0], [], threading.Event(), [0]

    class Node:
        def answers(self, service, client):
            looks[0] += 1
            now[0] += 0.05
            return True if looks[0] > 10 else None

        def send(self, client, on_answer):
            probed.set()

    pacer = Pacer(lambda handle, payload: sent.append(handle), Node(), "/s", clock=lambda: now[0])
    for number in range(30):
        pacer.requested(handle(1, number), together=True)
    for number in range(30):
        pacer.respond(handle(1, number), b"")
    assert probed.wait(30)
    assert len(sent) <= QUEUE
    pacer.close()


def test_a_client_whose_node_has_nothing_to_probe_is_paced_by_time_at_once():
    """Discovery tells that with its first request: nobody waits for what will never be there."""
    now, sent, known = [0.0], threading.Semaphore(0), threading.Event()

    class Node:
        def answers(self, service, client):
            known.set()
            return False

    pacer = Pacer(lambda *_: sent.release(), Node(), "/s", clock=lambda: now[0])
    for number in range(2 * WINDOW):
        pacer.requested(handle(1, number), together=True)
    assert known.wait(30)
    for number in range(2 * WINDOW):
        pacer.respond(handle(1, number), b"")
    for tick in range(WINDOW + 1):
        now[0] = tick * 1.001 * EVERY_S
        for _ in range(1 if tick else WINDOW):
            assert sent.acquire(timeout=30), "a response as time passes"
        assert not sent.acquire(blocking=False)
    pacer.close()


def test_a_node_that_was_started_again_releases_its_own_responses_and_none_of_its_predecessor():
    """It answers what either was asked; ten responses to the dead one would push out its own."""
    now, sent, answered, turn = [0.0], [], {}, threading.Event()

    class Node:
        def answers(self, service, client):
            return True

        def send(self, client, on_answer):
            answered[client] = on_answer
            turn.set()

        def same_node(self, client, other):
            return True

    def burst(client):
        turn.clear()
        for number in range(30):
            pacer.requested(handle(client, number), together=True)
        for number in range(30):
            pacer.respond(handle(client, number), b"")
        assert turn.wait(30)
        return next(reversed(answered))

    def release(client):
        turn.clear()
        before = len(sent)
        answered[client]()
        assert turn.wait(30)  # the pacer has had a turn since
        return len(sent) - before

    pacer = Pacer(lambda handle, payload: sent.append(handle), Node(), "/s", clock=lambda: now[0])
    killed = burst(1)
    now[0] = 2.0  # it has answered nothing for long
    assert release(killed) == 1  # nobody else has asked since
    now[0] = 4.0
    successor = burst(2)
    now[0] = 6.0
    before = len(sent)
    answered[killed]()
    assert release(successor) == len(sent) - before == 1
    pacer.close()


def test_clients_that_are_gone_are_forgotten():
    pace = Pace()
    for n in range(200):
        client = pace.client(handle(n, 0), float(n))
        client.requested(float(n))
        assert pace.take(client, float(n))
    assert len(pace.clients) <= 64


def test_of_many_clients_none_is_forgotten_that_asked_just_now():
    """Its account would begin anew, and it would get more than it keeps."""
    pace = Pace()
    for n in range(100):
        pace.client(handle(n, 0), 0.01 * n).requested(0.01 * n)
    assert len(pace.clients) == 100


def test_a_response_to_a_client_that_is_not_found_yet_is_sent_again():
    """Once and no more, when discovery has told the way to it; others are not held up."""
    sent: list[bytes] = []
    tries: list[bytes] = []
    found = threading.Event()

    def send(handle: bytes, payload: bytes) -> None:
        tries.append(payload)
        if payload == b"early" and len(tries) < 4:
            raise NotFoundYet("client will not receive response")
        sent.append(payload)
        if payload == b"early":
            found.set()

    pacer = Pacer(send, UNKNOWN, "/s")
    pacer.respond(bytes(24), b"early")
    pacer.respond(bytes(range(24)), b"other")
    assert found.wait(30)
    pacer.close()
    assert sorted(sent) == [b"early", b"other"]


def test_where_there_can_be_no_more_threads_a_later_response_has_one():
    """And what waited until then is sent, too."""
    sent, both, found = list[bytes](), threading.Event(), False

    def send(handle: bytes, payload: bytes) -> None:
        if not found:
            raise NotFoundYet("client will not receive response")
        sent.append(payload)
        if len(sent) == 2:
            both.set()

    pacer = Pacer(send, UNKNOWN, "/s")
    with no_more(), pytest.raises(OSError, match="TasksMax"):
        pacer.respond(bytes(24), b"1")
    pacer.respond(bytes(24), b"2")
    found = True
    assert both.wait(30)
    pacer.close()


def test_a_client_that_is_never_found_is_given_up(caplog):
    """What waited for it goes after a while, with a line in the log."""
    now, tries, both = 0.0, list[bytes](), threading.Event()

    def send(handle: bytes, payload: bytes) -> None:
        nonlocal now
        now += 11.0
        tries.append(payload)
        if payload == b"3":
            both.set()
        raise NotFoundYet("client will not receive response")

    pacer = Pacer(send, UNKNOWN, "/s", clock=lambda: now + time.monotonic())
    pacer.respond(bytes(24), b"1")
    pacer.respond(bytes(24), b"2")
    wait_for(lambda: "response_refused" in caplog.text)
    pacer.respond(bytes(24), b"3")
    assert both.wait(30)
    pacer.close()
    assert tries == [b"1", b"1", b"3"]


def test_clients_that_are_gone_hold_up_nobody():
    """Each is tried once, not again and again while another has much to take."""
    probes, tries, all_sent = _NoNodes(), Counter[int](), threading.Event()

    def send(handle: bytes, payload: bytes) -> None:
        who = handle[0]
        tries[who] += 1
        if who < 8:
            raise NotFoundYet("client will not receive response")
        if tries[who] == 40:
            all_sent.set()

    pacer = Pacer(send, probes, "/s")
    for who in range(8):
        probes.hidden.add(handle(who, 0)[:16])
        pacer.respond(handle(who, 0), b"")
    for n in range(40):
        pacer.requested(handle(8, n))
    for n in range(40):
        pacer.respond(handle(8, n), b"")
    assert all_sent.wait(30)
    looks, began = probes.looks, time.monotonic()
    for n in range(40):
        pacer.requested(handle(0, n))
        time.sleep(0.002)
    assert probes.looks - looks <= 1 + (time.monotonic() - began) / 0.02  # however busy it is
    pacer.close()
    assert tries == {**dict.fromkeys(range(8), 1), 8: 40}


def test_clients_that_are_given_up_hold_up_others_one_at_a_time():
    """ROS waits for each; responses to others go in between."""
    probes, ahead_s, tries, both = _NoNodes(), 0.0, list[int](), threading.Event()

    def send(handle: bytes, payload: bytes) -> None:
        who = handle[0]
        tries.append(who)
        if who < 8:
            time.sleep(0.02)
            raise NotFoundYet("client will not receive response")
        if len(tries) >= 200:
            both.set()

    pacer = Pacer(send, probes, "/s", clock=lambda: ahead_s + time.monotonic())
    probes.hidden = {handle(who, 0)[:16] for who in range(8)}
    for who in range(8):
        pacer.respond(handle(who, 0), b"")
    for n in range(200):
        pacer.requested(handle(8, n))
    for n in range(200):
        pacer.respond(handle(8, n), b"")
    began, ahead_s = len(tries), 11.0
    assert both.wait(30)
    pacer.close()
    given_up = [at for at, who in enumerate(tries) if who < 8 and at >= began]
    assert len(given_up) == 8
    assert all(later - at > 1 for at, later in itertools.pairwise(given_up))


def test_what_waits_for_a_client_to_be_found_does_not_come_all_at_once():
    """It was asked 64 times before discovery had found it, and keeps ten like any other."""
    now, tries, sent = 0.0, 0, []
    asked, all_sent = threading.Event(), threading.Event()

    def clock() -> float:
        """From then on the pacer's own thread alone reads it: time passes with each look."""
        nonlocal now
        now += asked.is_set() * EVERY_S / 2
        return now

    def send(handle: bytes, payload: bytes) -> None:
        nonlocal tries
        tries += asked.is_set()
        if tries < 5:
            assert payload == b"0"
            raise NotFoundYet("client will not receive response")
        sent.append(now)
        if len(sent) == 64:
            all_sent.set()

    pacer = Pacer(send, UNKNOWN, "/s", clock=clock)
    for n in range(64):
        pacer.requested(handle(1, n))
    for n in range(64):
        pacer.respond(handle(1, n), b"%d" % n)
    asked.set()
    assert all_sent.wait(30)
    pacer.close()
    assert all(n <= WINDOW + (at - sent[0]) / EVERY_S + 1 for n, at in enumerate(sent))
