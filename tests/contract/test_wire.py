"""The contract of links and listeners, on every implementation of `link.port`."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from fogft.errors import WireError
from fogft.link.port import Dialer, Incoming, Link, Probe, ProbeAnswer
from fogft.link.window import ATTEMPTS_LIMIT
from fogft.link.zenoh.replica.listener import ZenohListener
from fogft.link.zenoh.robot.dialer import ZenohDialer
from fogft.model import names
from fogft.model.refusal import Refusal
from fogft.model.replica import LinkState, ReplicaId, doubted_after_s
from fogft.model.type_definition import Definition
from tests.fakes.link import MemoryWire
from tests.fakes.waiting import wait_for
from tests.link.wire_pool import (
    LIMIT_S,
    POOL_UID,
    SERVICE,
    Authority,
    Owner,
    keys,
    peer,
    request_id,
)


class MemoryWorld:
    """The wire in memory, moved until what is awaited has come."""

    def __init__(self) -> None:
        self._wire = MemoryWire()
        self._dialers: list[Dialer] = []

    def listener(self, slot: int, generation: int, endpoint: str = "") -> ZenohListener:
        return self._wire.listener(ReplicaId(POOL_UID, slot, generation), endpoint)

    def dialer(self, **options: object) -> Dialer:
        return self._wire.dialer(**options)  # type: ignore[arg-type]

    def wait_for(self, condition: Callable[[], object]) -> None:
        for _ in range(1000):
            self._wire.pump()
            if condition():
                return
            self._wire.advance(0.05)
        raise AssertionError("the awaited condition never came")

    def settle(self) -> None:
        self._wire.advance(1.0)

    def mute(self, replica: Replica) -> None:
        self._wire.freeze(replica.listener.endpoint)

    def unmute(self, replica: Replica) -> None:
        self._wire.thaw(replica.listener.endpoint)

    def close(self) -> None:
        pass


class ZenohWorld:
    """Zenoh over loopback, both ends in this process."""

    def __init__(self, folder: Path) -> None:
        self._authority = Authority(folder)
        self._made: list[Dialer | ZenohListener] = []

    def listener(self, slot: int, generation: int, endpoint: str = "127.0.0.1:0") -> ZenohListener:
        files = self._authority.replica(slot, generation)
        listener = ZenohListener(endpoint, files, ReplicaId(POOL_UID, slot, generation))
        self._made.append(listener)
        return listener

    def dialer(self, **options: object) -> Dialer:
        options = {"robot": "robot", **options}
        files = self._authority.robot(str(options["robot"]))
        dialer = ZenohDialer(files, pool_uid=POOL_UID, **options)  # type: ignore[arg-type]
        self._made.append(dialer)
        return dialer

    def wait_for(self, condition: Callable[[], object]) -> None:
        wait_for(condition, LIMIT_S)

    def settle(self) -> None:
        """Give what must not happen a moment in which it could."""
        time.sleep(0.2)

    def mute(self, replica: Replica) -> None:
        """Let a replica answer no probe; in its own process that takes a thread that waits."""
        replica.speaks.clear()

    def unmute(self, replica: Replica) -> None:
        replica.speaks.set()

    def close(self) -> None:
        for made in self._made:
            made.close()


World = MemoryWorld | ZenohWorld


@pytest.fixture(params=["memory", "zenoh"])
def world(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[World]:
    made: World = MemoryWorld() if request.param == "memory" else ZenohWorld(tmp_path)
    yield made
    made.close()


class Replica:
    """A listener with a service that a test answers by hand, or at once with an echo."""

    def __init__(self, listener: ZenohListener, *, slot: int = 0, generation: int = 1) -> None:
        self.listener = listener
        self.requests: list[Incoming] = []
        self.probes: list[Probe] = []
        self.echo = False
        self.answer = ProbeAnswer(
            slot=slot, generation=generation, incarnation="first", ready=frozenset({SERVICE})
        )
        self.cancelled: list[bytes] = []
        self.speaks = threading.Event()
        self.speaks.set()
        listener.serve(keys(slot), self._request, self._probe, self._cancel)

    def _cancel(self, ids: Sequence[bytes]) -> None:
        self.cancelled += ids

    def _request(self, incoming: Incoming) -> None:
        self.requests.append(incoming)
        if self.echo:
            incoming.reply(incoming.payload)

    def _probe(self, probe: Probe) -> ProbeAnswer:
        self.probes.append(probe)
        self.speaks.wait(LIMIT_S)
        return self.answer


@pytest.fixture
def replica(world: World) -> Replica:
    return Replica(world.listener(0, 1))


@pytest.fixture
def owner() -> Owner:
    return Owner()


@pytest.fixture
def link(world: World, replica: Replica, owner: Owner) -> Link:
    """A link that is up."""
    made = world.dialer().dial(peer(replica.listener.endpoint), keys(0), owner)
    world.wait_for(lambda: made.usable)
    return made


def test_a_link_is_connecting_until_its_first_probe_is_answered(world: World, owner: Owner) -> None:
    listener = world.listener(0, 1)
    link = world.dialer().dial(peer(listener.endpoint), keys(0), owner)
    assert link.status().state is LinkState.CONNECTING
    assert not link.usable
    assert link.ready == frozenset()
    assert not link.offer(SERVICE, request_id(1), b"", 1.0)
    replica = Replica(listener)
    world.wait_for(lambda: link.usable)
    status = link.status()
    assert status.state is LinkState.UP
    assert status.probe_answer is not None
    assert replace(status.probe_answer, accepts=frozenset()) == replica.answer
    assert link.ready == {SERVICE}
    assert status.detail == ""
    assert owner.changes > 0


def test_a_request_gets_its_answer_once(
    world: World, replica: Replica, link: Link, owner: Owner
) -> None:
    assert link.offer(SERVICE, request_id(7), b"question", 5.0)
    world.wait_for(lambda: replica.requests)
    incoming = replica.requests[0]
    assert (incoming.service, incoming.request_id) == (SERVICE, request_id(7))
    assert (incoming.robot, incoming.payload) == ("robot", b"question")
    assert 0 < incoming.remaining_s <= 5.0
    incoming.reply(b"answer")
    incoming.reply(b"another")
    incoming.refuse(Refusal.CRASHED)
    world.wait_for(lambda: owner.answers)
    world.settle()
    assert len(owner.answers) == 1
    answer = owner.answers[0][1]
    assert (answer.payload, answer.refusal, answer.service) == (b"answer", None, SERVICE)
    assert link.status().in_flight == 0


@pytest.mark.parametrize("reason", [Refusal.NOT_READY, Refusal.OVERLOADED, Refusal.CRASHED])
def test_a_refusal_arrives_with_its_reason(
    world: World, replica: Replica, link: Link, owner: Owner, reason: Refusal
) -> None:
    link.offer(SERVICE, request_id(1), b"", 5.0)
    world.wait_for(lambda: replica.requests)
    replica.requests[0].refuse(reason)
    world.wait_for(lambda: owner.answers)
    assert [(a.payload, a.refusal) for a in owner.of(1)] == [(None, reason)]
    replica.requests[0].refuse(Refusal.LOST)
    assert replica.listener.refusals() == {reason.value: 1}


def test_answers_come_back_in_any_order_to_their_own_requests(
    world: World, replica: Replica, link: Link, owner: Owner
) -> None:
    for number in range(50):
        assert link.offer(SERVICE, request_id(number), b"", 5.0)
    world.wait_for(lambda: len(replica.requests) == 50)
    for incoming in reversed(replica.requests):
        incoming.reply(b"for " + incoming.request_id)
    world.wait_for(lambda: len(owner.answers) == 50)
    for number in range(50):
        assert [a.payload for a in owner.of(number)] == [b"for " + request_id(number)]


def test_an_unknown_service_is_not_taken(link: Link) -> None:
    assert not link.offer("/other", request_id(1), b"", 1.0)


def test_an_open_request_is_not_taken_twice(
    world: World, replica: Replica, link: Link, owner: Owner
) -> None:
    assert link.offer(SERVICE, request_id(1), b"a", 5.0)
    assert not link.offer(SERVICE, request_id(1), b"a", 5.0)
    world.wait_for(lambda: replica.requests)
    replica.requests[0].reply(b"")
    world.wait_for(lambda: owner.answers)
    assert link.offer(SERVICE, request_id(1), b"a", 5.0)


def test_a_full_window_says_no_and_later_tells_of_room(
    world: World, replica: Replica, link: Link, owner: Owner
) -> None:
    """However many are offered, no more are taken than the window holds; none blocks."""
    taken = [link.offer(SERVICE, request_id(n), b"", 60.0) for n in range(ATTEMPTS_LIMIT + 20)]
    room = sum(taken)  # a few more, for pulls of topics
    assert ATTEMPTS_LIMIT <= room < ATTEMPTS_LIMIT + 20
    assert taken == [True] * room + [False] * (len(taken) - room)
    assert link.usable
    assert link.status().in_flight == room
    world.wait_for(lambda: len(replica.requests) == room)
    changes = owner.changes
    for incoming in replica.requests:
        incoming.reply(b"")
    world.wait_for(lambda: len(owner.answers) == room)
    world.wait_for(lambda: owner.changes > changes)
    assert link.offer(SERVICE, request_id(9999), b"", 1.0)


def test_a_forgotten_request_frees_its_room_and_its_answer_is_late(
    world: World, replica: Replica, link: Link, owner: Owner
) -> None:
    link.offer(SERVICE, request_id(1), b"12345", 5.0)
    assert link.status().in_flight == 1
    world.wait_for(lambda: replica.requests)
    link.forget(request_id(1))
    link.forget(request_id(2))
    assert link.status().in_flight == 0
    replica.requests[0].reply(b"late")
    link.offer(SERVICE, request_id(3), b"", 5.0)
    world.wait_for(lambda: len(replica.requests) == 2)
    replica.requests[1].reply(b"")
    world.wait_for(lambda: owner.of(3))
    world.wait_for(lambda: owner.too_late)
    assert owner.of(1) == []
    assert owner.too_late == [(SERVICE, request_id(1))]


def test_the_replica_is_told_what_was_forgotten(
    world: World, replica: Replica, link: Link, owner: Owner
) -> None:
    for number in range(3):
        link.offer(SERVICE, request_id(number), b"", 5.0)
    world.wait_for(lambda: len(replica.requests) == 3)
    for number in (0, 2):
        link.forget(request_id(number))
    link.flush()
    world.wait_for(lambda: len(replica.cancelled) == 2)
    assert replica.cancelled == [request_id(0), request_id(2)]
    replica.requests[0].refuse(Refusal.CANCELLED)
    replica.requests[2].refuse(Refusal.LATE)  # it had been run, which is told of
    world.wait_for(lambda: owner.too_late)
    assert owner.too_late == [(SERVICE, request_id(2))]
    world.wait_for(lambda: owner.dropped)
    assert owner.dropped == [(SERVICE, request_id(0))]
    assert owner.answers == []


def test_the_replica_is_not_told_what_it_has_answered(
    world: World, replica: Replica, link: Link, owner: Owner
) -> None:
    """A quick service's losers answer before a message could reach them: none is sent."""
    replica.echo = True
    link.offer(SERVICE, request_id(1), b"", 5.0)
    world.wait_for(lambda: owner.answers)
    link.forget(request_id(1))
    link.flush()
    world.settle()
    assert replica.cancelled == []


def test_an_attempt_whose_time_is_up_is_lost(
    world: World, replica: Replica, link: Link, owner: Owner
) -> None:
    link.offer(SERVICE, request_id(1), b"", 0.3)
    world.wait_for(lambda: owner.answers)
    assert [(a.payload, a.refusal) for a in owner.of(1)] == [(None, Refusal.LOST)]
    assert link.usable


def test_a_request_that_the_replica_forgets_is_lost_at_once(
    world: World, replica: Replica, link: Link, owner: Owner
) -> None:
    """Long before its time is up: another replica may be asked meanwhile."""
    link.offer(SERVICE, request_id(1), b"", 3600.0)
    world.wait_for(lambda: replica.requests)
    replica.requests.clear()
    world.wait_for(lambda: owner.answers)
    assert [(a.payload, a.refusal) for a in owner.of(1)] == [(None, Refusal.LOST)]


def test_when_the_replica_dies_its_attempts_are_lost_and_a_new_one_is_found(
    world: World, replica: Replica, link: Link, owner: Owner
) -> None:
    link.offer(SERVICE, request_id(1), b"", 60.0)
    world.wait_for(lambda: replica.requests)
    replica.listener.close()
    world.wait_for(lambda: owner.answers)
    world.wait_for(lambda: not link.usable)
    assert [a.refusal for a in owner.of(1)] == [Refusal.LOST]
    assert link.status().state is LinkState.SUSPECT
    assert link.ready == frozenset()
    assert not link.offer(SERVICE, request_id(2), b"", 1.0)
    again = Replica(world.listener(0, 1, replica.listener.endpoint))
    again.echo = True
    world.wait_for(lambda: link.usable)
    assert link.offer(SERVICE, request_id(1), b"again", 5.0)
    world.wait_for(lambda: len(owner.of(1)) == 2)
    assert owner.of(1)[1].payload == b"again"
    assert link.status().reopened == 1


def test_silence_grows_while_nobody_is_there(
    world: World, replica: Replica, link: Link, owner: Owner
) -> None:
    assert link.status().silent_for_s < 1.0
    replica.listener.close()
    world.wait_for(lambda: link.status().silent_for_s > 0.3)
    heard_age_s = link.status().heard_age_s
    assert heard_age_s is not None
    assert heard_age_s >= 0.3


def test_an_answer_that_is_late_is_told_before_the_link_is_suspect(
    world: World, replica: Replica, owner: Owner
) -> None:
    """Once a silence; requests go there all the same, and the next answer ends it."""
    endpoint = replica.listener.endpoint
    link = world.dialer(suspect_after_s=600.0).dial(peer(endpoint), keys(0), owner)
    world.wait_for(lambda: link.usable)
    world.settle()
    changes = owner.changes
    world.mute(replica)
    world.wait_for(lambda: owner.changes > changes)
    status = link.status()
    assert status.state is LinkState.UP
    assert link.usable
    assert status.silent_for_s >= doubted_after_s(status.rtt_s)
    world.settle()
    assert owner.changes == changes + 1
    world.unmute(replica)
    world.wait_for(lambda: link.status().silent_for_s == 0.0)


def test_a_closed_link_loses_what_is_open(
    world: World, replica: Replica, link: Link, owner: Owner
) -> None:
    link.offer(SERVICE, request_id(1), b"", 60.0)
    world.wait_for(lambda: replica.requests)
    link.close()
    link.close()
    world.wait_for(lambda: owner.answers)
    replica.requests[0].reply(b"late")
    world.settle()
    assert [a.refusal for a in owner.of(1)] == [Refusal.LOST]
    assert not link.usable
    assert not link.offer(SERVICE, request_id(2), b"", 1.0)


def test_what_a_probe_says_is_seen_on_the_link(
    world: World, replica: Replica, link: Link, owner: Owner
) -> None:
    replica.answer = ProbeAnswer(
        slot=0, generation=1, incarnation="first", ready=frozenset(), draining=True, detail="starts"
    )
    world.wait_for(lambda: link.leaving)
    assert link.ready == frozenset()
    assert link.usable
    probe_answer = link.status().probe_answer
    assert probe_answer is not None
    assert probe_answer.detail == "starts"


def test_a_probe_tells_of_its_robot(world: World, replica: Replica, owner: Owner) -> None:
    dialer = world.dialer(robot="ada")
    link = dialer.dial(peer(replica.listener.endpoint), keys(0), owner)
    world.wait_for(lambda: link.usable)
    assert replica.probes[-1].robot == "ada"


def test_definitions_are_asked_for_once_and_kept(
    world: World, replica: Replica, owner: Owner
) -> None:
    """They are long and do not change while a replica lives."""
    told = {"a/srv/B": Definition("h", {"request": (("x", "int32"),)})}
    replica.answer = ProbeAnswer(
        slot=0, generation=1, incarnation="first", ready=frozenset({SERVICE}), types=told
    )
    link = world.dialer().dial(peer(replica.listener.endpoint), keys(0), owner)
    world.wait_for(lambda: link.usable)
    assert replica.probes[0].describe
    replica.answer = ProbeAnswer(slot=0, generation=1, incarnation="first", ready=frozenset())
    world.wait_for(lambda: not link.ready)
    answer = link.status().probe_answer
    assert answer is not None
    assert answer.types == told
    asked = len(replica.probes)
    world.wait_for(lambda: len(replica.probes) > asked)
    assert not replica.probes[-1].describe


def test_a_service_can_be_added_to_a_listener_that_serves(
    world: World, replica: Replica, owner: Owner
) -> None:
    key = names.service_key(POOL_UID, 0, "/more", "std_srvs/srv/SetBool")
    link = world.dialer().dial(peer(replica.listener.endpoint), {**keys(0), "/more": key}, owner)
    world.wait_for(lambda: link.usable)
    replica.listener.add({"/more": key})
    request = b"m" * 16
    world.wait_for(lambda: link.offer("/more", request, b"CDR.more", 5.0))
    world.wait_for(lambda: replica.requests)
    assert replica.requests[0].service == "/more"
    replica.requests[0].reply(b"CDR.answer")
    world.wait_for(lambda: owner.answers)
    assert (owner.answers[0][1].service, owner.answers[0][1].payload) == ("/more", b"CDR.answer")


@pytest.mark.parametrize("said", [(1, 1), (0, 2)], ids=["another slot", "another generation"])
def test_a_replica_that_says_it_is_another_never_comes_up(
    world: World, owner: Owner, said: tuple[int, int]
) -> None:
    replica = Replica(world.listener(0, 1))
    replica.answer = ProbeAnswer(
        slot=said[0], generation=said[1], incarnation="first", ready=frozenset({SERVICE})
    )
    link = world.dialer().dial(peer(replica.listener.endpoint), keys(0), owner)
    words = f"identifies itself as {said[0]}.{said[1]}, not 0.1"
    world.wait_for(lambda: words in link.status().detail)
    assert not link.usable
    assert link.status().state is LinkState.CONNECTING


def test_another_generation_at_the_endpoint_is_not_talked_to(world: World, owner: Owner) -> None:
    replica = Replica(world.listener(0, 2), generation=2)
    link = world.dialer().dial(peer(replica.listener.endpoint, generation=1), keys(0), owner)
    world.wait_for(lambda: "has the certificate of" in link.status().detail)
    assert not link.usable
    assert replica.probes == []


def test_nobody_there_is_said_in_words(world: World, owner: Owner) -> None:
    listener = world.listener(0, 1)
    link = world.dialer().dial(peer(listener.endpoint), keys(0), owner)
    world.wait_for(lambda: "connection refused" in link.status().detail)


def test_two_listeners_cannot_have_one_endpoint(world: World, replica: Replica) -> None:
    with pytest.raises(WireError, match="cannot listen"):
        Replica(world.listener(0, 1, replica.listener.endpoint))
