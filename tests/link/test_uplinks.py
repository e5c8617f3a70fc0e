"""Several uplinks as one link: each attempt ends once, and an uplink that is lost costs nothing."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.link import uplinks
from fogft.link.port import Answer, Peer
from fogft.link.uplinks import UplinkDialer, choose
from fogft.model import topic
from fogft.model.choices import Freshness, UplinkPolicy, is_interface
from fogft.model.refusal import Refusal
from fogft.model.replica import ReplicaId
from fogft.model.spec import ServiceSpec
from tests.fakes.proxy import UID, FakeDialer

READY = frozenset({"/s"})
ID = b"i" * 16
LOST = Refusal.LOST
PEER = Peer(ReplicaId(UID, 0, 1), "h:1", "replica")


class Owner:
    def __init__(self) -> None:
        self.answers: list[Answer] = []
        self.too_late: list[bytes] = []
        self.changes = 0

    def answered(self, link, answer) -> None:
        self.answers.append(answer)

    def late(self, link, answer) -> None:
        self.too_late.append(answer.request_id)

    def changed(self, link) -> None:
        self.changes += 1


class Scene:
    def __init__(self, policy: str, uplinks: int = 2) -> None:
        self.owner, inner = Owner(), FakeDialer()
        dialer = self.dialer = UplinkDialer(inner)
        dialer.use(
            [f"if{i}" for i in range(uplinks)],
            [ServiceSpec("/s", "t/srv/T", uplink_policy=UplinkPolicy(policy))],
        )
        self.link = dialer.dial(PEER, {"/s": "k"}, self.owner)
        self.uplinks = inner.links
        for one in self.uplinks:
            one.ready = READY

    def offer(self, id: bytes = ID) -> bool:
        return self.link.offer("/s", id, b"payload", 5.0)

    def counts(self) -> list[int]:
        return [len(one.offered) for one in self.uplinks]

    def end(
        self, at: int, payload: bytes | None = None, refusal: Refusal | None = None, id: bytes = ID
    ) -> None:
        one = self.uplinks[at]
        one.events.answered(one, Answer(id, payload, refusal, "/s"))

    def lose(self, at: int) -> None:
        self.uplinks[at].ready = frozenset()
        for _, id, _, _ in list(self.uplinks[at].offered):
            self.end(at, refusal=LOST, id=id)


def test_each_uplink_is_dialled_through_its_interface():
    scene = Scene("prefer", 3)
    assert [one.peer.interface for one in scene.uplinks] == ["if0", "if1", "if2"]
    assert [u["interface"] for u in scene.link.status().uplinks] == ["if0", "if1", "if2"]


def test_all_sends_on_each_and_takes_the_first_answer():
    scene = Scene("all")
    assert scene.offer()
    assert scene.counts() == [1, 1]
    scene.end(1, b"a")
    scene.end(0, b"a")
    assert [a.payload for a in scene.owner.answers] == [b"a"]
    assert scene.uplinks[0].forgotten == [ID]
    one = scene.uplinks[0]
    one.events.late(one, Answer(ID, b"a"))
    assert scene.owner.too_late == []  # the replica ran it once: nothing was in vain


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_copy_that_was_dropped_on_one_uplink_ends_nothing_while_another_runs(order):
    """Whatever comes first, the replica's work on a request is told of once."""
    scene = Scene("all")
    assert scene.offer()
    scene.link.forget(ID)
    told = [Answer(ID, refusal=Refusal.CANCELLED), Answer(ID, b"ran")]
    for at in order:
        one = scene.uplinks[at]
        one.events.late(one, told[at])
        assert scene.owner.too_late == ([] if at == 0 and order == (0, 1) else [ID])
    scene.offer(b"j" * 16)
    scene.link.forget(b"j" * 16)
    for one in scene.uplinks:  # sent on neither
        one.events.late(one, Answer(b"j" * 16, refusal=Refusal.CANCELLED))
    assert scene.owner.too_late == [ID, b"j" * 16]


def test_each_service_has_its_own_policy():
    """Over the same links at the same time."""
    scene = Scene("all")
    policies = [("/s", UplinkPolicy.ALL), ("/t", UplinkPolicy.PREFER)]
    scene.dialer.use(
        ["if0", "if1"], [ServiceSpec(n, "t/srv/T", uplink_policy=p) for n, p in policies]
    )
    assert scene.offer()
    assert scene.counts() == [1, 1]
    assert scene.link.offer("/t", b"t" * 16, b"payload", 5.0)
    assert scene.counts() == [2, 1]


def test_links_are_dialled_anew_for_other_interfaces_or_ways_only():
    one, other = ServiceSpec("/s", "t/srv/T"), ServiceSpec("/t", "t/srv/T")
    dialer = UplinkDialer(FakeDialer())
    assert dialer.use(["if0"], [one])
    assert not dialer.use(["if0"], [one, other])
    assert dialer.use(["if0", "if1"], [one])
    assert dialer.use(["if0", "if1"], [replace(one, freshness=Freshness.LATEST)])


def test_prefer_goes_back_and_failover_does_not():
    for policy, expected in (("prefer", [2, 1]), ("failover", [1, 2])):
        scene = Scene(policy)
        assert scene.offer(b"1" * 16)
        scene.uplinks[0].ready = frozenset()
        assert scene.offer(b"2" * 16)
        scene.uplinks[0].ready = READY
        assert scene.offer(b"3" * 16)
        assert scene.counts() == expected, policy


def test_an_uplink_that_is_lost_again_and_again_comes_last_for_ever_longer(monkeypatch):
    """Where large packets vanish it opens each time, and each time what it was given is lost."""
    scene, now = Scene("prefer"), [1000.0]
    monkeypatch.setattr(uplinks.time, "monotonic", lambda: now[0])
    one = scene.uplinks[0]

    def rested_s() -> float:
        for ready in (READY, frozenset(), READY):
            one.ready = ready
            one.events.changed(one)
        lost_at = now[0]
        while scene.offer() and not one.offered:
            scene.link.forget(ID)
            now[0] += 0.5
        scene.link.forget(ID)
        one.offered.clear()
        return now[0] - lost_at

    assert [rested_s() for _ in range(4)] == [2.0, 4.0, 8.0, 16.0]
    now[0] += 3600.0
    assert rested_s() == 2.0


def test_failover_goes_back_to_a_good_uplink_rather_than_on_to_one_that_rests():
    scene = Scene("failover", 3)

    def change(at: int, ready: frozenset[str]) -> None:
        scene.uplinks[at].ready = ready
        scene.uplinks[at].events.changed(scene.uplinks[at])

    scene.uplinks[0].ready = frozenset()
    change(1, READY)
    assert scene.offer()
    scene.link.forget(ID)
    scene.uplinks[0].ready = READY
    for ready in (READY, frozenset(), READY):
        change(2, ready)
    assert scene.offer()
    scene.link.forget(ID)
    assert scene.counts() == [0, 2, 0]
    change(1, frozenset())
    change(1, READY)  # it is back, and rests: nothing was asked meanwhile
    assert scene.offer()
    assert scene.counts() == [1, 2, 0]


def test_what_is_too_slow_on_one_uplink_goes_out_on_the_other():
    """It ends as lost where no uplink takes it any more, so that another replica is asked."""
    scene = Scene("failover")
    assert scene.offer()
    scene.uplinks[0].room = 1
    scene.end(0, refusal=Refusal.TOO_SLOW)
    scene.link.flush()
    assert (scene.counts(), scene.owner.answers) == ([1, 1], [])
    scene.uplinks[1].room = 1
    scene.end(1, refusal=Refusal.TOO_SLOW)
    scene.link.flush()
    assert [a.refusal for a in scene.owner.answers] == [LOST]


def test_what_was_on_a_lost_uplink_goes_out_on_the_other():
    """The owner hears nothing of it, but that it shall flush: an event may send nothing."""
    scene = Scene("prefer")
    scene.offer()
    scene.lose(0)
    assert (scene.owner.answers, scene.counts()) == ([], [1, 0])
    assert scene.owner.changes
    scene.link.flush()
    assert scene.counts() == [1, 1]
    assert scene.uplinks[1].offered[0][2] == b"payload"
    scene.end(1, b"a")
    assert [a.payload for a in scene.owner.answers] == [b"a"]


def test_no_message_of_a_topic_overtakes_what_waits_to_go_out_again():
    """A request may: it is answered by itself."""
    scene = Scene("prefer")
    scene.offer()
    scene.lose(0)
    take, meanwhile = scene.uplinks[1].offer, []

    def message() -> bool:
        return scene.link.offer(f"{topic.PREFIX}/t", b"j" * 16, b"m", 5.0)

    def taking(*args, **kwargs) -> bool:
        scene.uplinks[1].offer = take
        meanwhile.append(message())
        return take(*args, **kwargs)

    assert not message()
    assert scene.offer(b"k" * 16)
    scene.uplinks[1].offer = taking
    scene.link.flush()
    assert meanwhile == [False]
    assert message()


def test_what_an_uplink_did_not_carry_before_the_deadline_is_lost():
    scene = Scene("prefer")
    assert scene.link.offer("/s", ID, b"payload", 0.0)
    scene.end(0, refusal=LOST)
    assert [a.refusal for a in scene.owner.answers] == [LOST]
    scene.link.flush()
    assert scene.counts() == [1, 0]


def test_only_uplinks_that_are_up_count_as_slow_or_not():
    scene = Scene("prefer")
    scene.uplinks[1].thin = True
    assert not scene.link.thin
    scene.uplinks[0].ready = frozenset()
    assert scene.link.thin


def test_messages_of_a_topic_stay_on_their_uplink_while_any_is_under_way():
    """The preferred one that comes back would have them overtake those before."""
    scene, name = Scene("prefer"), f"{topic.PREFIX}/t"
    scene.uplinks[0].ready = frozenset()
    assert scene.link.offer(name, b"1" * 16, b"m", 5.0)
    scene.uplinks[0].ready = READY
    assert scene.link.offer(name, b"2" * 16, b"m", 5.0)
    assert scene.counts() == [0, 2]
    before = scene.uplinks[1].offer
    scene.uplinks[1].offer = lambda *args, **kwargs: True  # its certificate is renewed
    assert not scene.link.offer(name, b"3" * 16, b"m", 5.0), "on a new connection, too"
    scene.uplinks[1].offer = before
    for id in (b"1" * 16, b"2" * 16):
        scene.end(1, b"", id=id)
    assert scene.link.offer(name, b"3" * 16, b"m", 5.0)
    assert scene.counts() == [1, 2]


def test_with_no_uplink_left_it_is_lost_once():
    scene = Scene("all")
    scene.offer()
    scene.lose(0)
    scene.lose(1)
    scene.link.flush()
    assert [a.refusal for a in scene.owner.answers] == [LOST]
    assert not scene.offer()


def test_a_refusal_counts_when_no_other_copy_is_under_way():
    scene = Scene("all")
    scene.offer()
    scene.end(0, refusal=Refusal.OVERLOADED)
    assert scene.owner.answers == []
    scene.end(1, refusal=Refusal.OVERLOADED)
    assert [a.refusal for a in scene.owner.answers] == [Refusal.OVERLOADED]


def test_what_is_forgotten_is_forgotten_on_every_uplink():
    scene = Scene("all")
    scene.offer()
    scene.link.forget(ID)
    assert [one.forgotten for one in scene.uplinks] == [[ID], [ID]]
    scene.lose(0)
    assert scene.owner.answers == []


def test_a_full_uplink_is_passed_over():
    scene = Scene("prefer")
    scene.uplinks[0].room = 0
    assert scene.offer()
    assert scene.counts() == [0, 1]
    scene.uplinks[1].room = 1
    assert not scene.offer(b"2" * 16)


def test_what_is_on_this_machine_takes_no_uplink():
    """The door through which replicas dial in."""
    dialer = UplinkDialer(FakeDialer())
    dialer.use(["if0"], [])
    link = dialer.dial(Peer(PEER.id, "127.0.0.1:9", "n"), {}, Owner())
    assert link.peer.interface == ""


step = st.sampled_from(["offer", "answer", "refuse", "lose", "back", "forget", "flush"])


@given(
    st.sampled_from(list(UplinkPolicy)),
    st.lists(st.tuples(step, st.integers(0, 2), st.integers(0, 3)), max_size=60),
)
def test_each_accepted_attempt_ends_once_whatever_happens(policy, steps):
    """Exactly one `answered` for each offer that was taken, but for those forgotten."""
    scene = Scene(policy.value, 3)
    taken: dict[bytes, int] = {}
    forgotten: set[bytes] = set()
    number = 0
    for what, at, which in steps:
        one = scene.uplinks[at]
        open_ = [o[1] for o in one.offered]
        if what == "offer":
            number += 1
            id = number.to_bytes(16, "big")
            if scene.offer(id):
                taken[id] = 0
        elif what in ("answer", "refuse") and open_:
            id = open_[which % len(open_)]
            one.offered = [o for o in one.offered if o[1] != id]
            payload = b"a" if what == "answer" else None
            scene.end(at, payload, None if payload else Refusal.OVERLOADED, id)
        elif what == "lose":
            scene.lose(at)
            one.offered = []
        elif what == "back":
            one.ready = READY
        elif what == "forget" and taken:
            id = list(taken)[which % len(taken)]
            if not any(a.request_id == id for a in scene.owner.answers):
                forgotten.add(id)
            scene.link.forget(id)
        elif what == "flush":
            scene.link.flush()
    for at in range(3):
        scene.lose(at)
    scene.link.flush()
    for answer in scene.owner.answers:
        if answer.request_id in taken:
            taken[answer.request_id] += 1
    assert {id: count for id, count in taken.items() if id not in forgotten and count != 1} == {}
    assert all(taken[id] == 0 for id in forgotten)


@pytest.mark.parametrize("name", ["", "a b", "x" * 16, "..", "eth0/1", "é"])
def test_what_is_no_interface(name):
    assert not is_interface(name)


def test_nothing_is_chosen_where_nothing_is_up():
    for policy in UplinkPolicy:
        assert choose(policy, [], 1)[0] == []
