"""What a replica of a shared service says of itself: never more than it still has."""

from __future__ import annotations

from fogft.core import shared_orders
from fogft.core.shared_book import SESSIONS_LIMIT, Applied, Book, decode
from fogft.core.shared_orders import Entry, RequestId, Vote
from fogft.core.shared_replica import SharedReplica
from fogft.ordering import orders
from fogft.ordering.orders import START, Op
from fogft.ordering.replica import Begin, Refuse, Reply

EPOCH = orders.next_epoch(0, 1)
MEMBERS = (7, 8, 9)


class Scene:
    """A replica whose service adds up what it is given."""

    def __init__(self) -> None:
        self.machine: SharedReplica[str] = SharedReplica(7)
        self.machine.serving = True
        self.total = 0
        self.ended: dict[str, bytes | str] = {}

    def order(self, op: Op, index: int = 0, payload: bytes = b"", *, epoch: int = EPOCH) -> str:
        to = f"{op.name} {index} {len(self.ended)}"
        self.do(self.machine.order(op, epoch, index, payload, robot="r", to=to))
        return to

    def do(self, effects: list) -> None:
        for effect in effects:
            if isinstance(effect, Reply):
                self.ended[effect.to] = effect.payload
            elif isinstance(effect, Refuse):
                self.ended[effect.to] = effect.reason
            else:
                self.work(effect)

    def work(self, begun: Begin, ok: bool = True) -> None:
        answer: bytes | None = b""
        if begun.op is Op.APPLY:
            self.total += int(begun.payload)
            answer = b"%d" % self.total
        elif begun.op is Op.SNAPSHOT:
            answer = b"%d" % self.total
        elif begun.payload == b"bad":
            answer = None
        else:
            self.total = int(begun.payload)
        self.do(self.machine.done(begun.serial, answer))

    def vote(self, epoch: int = EPOCH) -> Vote:
        payload = self.ended[self.order(Op.CLAIM, epoch=epoch)]
        assert isinstance(payload, bytes)
        return shared_orders.decode_vote(payload)

    def join(self, goal: int = 0) -> None:
        vote = self.vote()
        payload = orders.encode_join(vote.position, goal)
        self.order(Op.JOIN, 0, shared_orders.encode_word(vote.life, payload))

    def restore(self, index: int, state: bytes, goal: int, life: int) -> bytes | str:
        payload = shared_orders.encode_word(life, orders.encode_snapshot(goal, state))
        return self.ended[self.order(Op.RESTORE, index, payload)]

    def apply(self, index: int, entry: Entry) -> bytes | str:
        return self.ended[self.order(Op.APPLY, index, entry.encode())]

    def snapshot(self) -> tuple[int, bytes]:
        payload = self.ended[self.order(Op.SNAPSHOT)]
        assert isinstance(payload, bytes)
        return orders.decode_snapshot(payload)

    def listen(self, committed: int) -> str:
        return self.order(Op.LISTEN, 0, shared_orders.encode_listen(committed, again=False))


def request(seq: int, body: bytes = b"1", *, wanted: bool = True, floor: int = 0) -> Entry:
    return Entry(RequestId(5, seq), floor, body, wanted)


def member(numbers: int = 3) -> Scene:
    """Return one that has applied as many requests, each of which adds one."""
    scene = Scene()
    scene.join()
    scene.apply(1, Entry(members=MEMBERS))
    for seq in range(1, numbers + 1):
        scene.apply(seq + 1, request(seq))
    return scene


def test_one_that_lost_its_state_has_no_vote_until_it_is_as_far_as_the_order_was():
    scene = member()
    assert scene.vote().whole
    index, state = scene.snapshot()
    scene.machine.lost()
    scene.machine.serving, scene.total = True, 0
    lost = scene.vote()
    assert (lost.position, lost.whole, lost.life) == (START, False, 1)
    assert scene.machine.promised == EPOCH, "what it promised it knows"
    scene.restore(index, state, goal=index + 1, life=1)
    assert not scene.vote().whole
    scene.apply(index + 1, request(4))
    assert scene.vote().whole
    assert scene.total == 4


def test_a_restore_from_before_the_loss_is_refused():
    """Its goal knows nothing of what was applied since: the vote would come too early."""
    scene = member()
    index, state = scene.snapshot()
    scene.machine.lost()
    scene.machine.serving = True
    assert scene.restore(index, state, goal=index, life=0) == orders.NOT_JOINED
    assert not scene.vote().whole


def test_a_restore_that_failed_takes_the_vote():
    scene = member()
    _, state = scene.snapshot()
    book = scene.machine.book.encode()
    scene.restore(9, book + b"bad", goal=9, life=0)
    vote = scene.vote()
    assert (vote.sound, vote.whole, vote.life) == (False, False, 1)
    assert scene.restore(2, state, goal=2, life=0) == orders.NOT_JOINED


def test_it_never_goes_back_within_a_term():
    """A copy of an early restore comes while the replica waits for a later one."""
    scene = member()
    early = scene.machine.book.encode() + b"1"
    scene.machine.joined = False
    scene.restore(2, early, goal=2, life=0)
    assert (scene.machine.position.index, scene.total) == (4, 3)


def test_one_that_never_was_a_member_may_begin_anew_after_a_loss():
    scene = Scene()
    scene.join()
    scene.machine.lost()
    scene.machine.serving = True
    assert scene.vote().whole


def test_an_id_is_applied_once_and_answered_as_often_as_it_comes():
    scene = member(1)
    assert shared_orders.decode_applied(scene.apply(3, request(1))) == (7, b"1")
    assert shared_orders.decode_applied(scene.apply(4, request(1, wanted=False))) == (7, None)
    assert scene.total == 1
    scene.apply(5, request(2, floor=2))
    assert shared_orders.decode_applied(scene.apply(6, request(1))) == (7, None), "forgotten"
    assert scene.total == 2


def test_what_is_handed_in_is_told_once_and_answered_only_when_it_is_committed():
    scene = member(1)
    listens = scene.listen(2)
    asks = scene.order(Op.HAND_IN, 9, shared_orders.encode_word(0, b"1"), epoch=6)
    (told,) = shared_orders.decode_handed(scene.ended[listens])
    assert (told.id, told.body) == (RequestId(6, 9), b"1")
    again = scene.listen(2)
    scene.apply(3, Entry(told.id, told.floor, told.body))
    assert asks not in scene.ended, "applied here, and perhaps nowhere else"
    scene.listen(3)
    assert scene.ended[again] == b"", "one listens at a time"
    assert shared_orders.decode_answer(scene.ended[asks])[1] == b"2"


def test_what_was_handed_in_is_told_to_the_next_sequencer_too():
    scene = member(1)
    first = scene.listen(2)
    asks = scene.order(Op.HAND_IN, 9, shared_orders.encode_word(0, b"1"), epoch=6)
    assert scene.ended[first]
    later = orders.next_epoch(EPOCH, 3)
    vote = scene.vote(later)
    join = orders.encode_join(vote.position, 2)
    scene.order(Op.JOIN, 0, shared_orders.encode_word(vote.life, join), epoch=later)
    payload = shared_orders.encode_listen(2, again=False)
    listens = scene.order(Op.LISTEN, 0, payload, epoch=later)
    assert [handed.id for handed in shared_orders.decode_handed(scene.ended[listens])] == [(6, 9)]
    assert asks not in scene.ended


def test_a_book_survives_a_snapshot_and_is_bounded():
    book = Book()
    book.members = MEMBERS
    for session in range(1, SESSIONS_LIMIT + 3):
        book.note(Entry(RequestId(session, 4), 3), Applied(session, b"a"))
    book.note(Entry(RequestId(9, 5)), Applied(999, None))
    copy, rest = decode(book.encode() + b"state")
    assert (copy.encode(), rest, copy.members) == (book.encode(), b"state", MEMBERS)
    assert copy.find(RequestId(9, 5)) == Applied(999, None)
    assert copy.find(RequestId(1, 4)) is None, "the session that asked longest ago"
    assert copy.forgets(RequestId(9, 2))
    assert not copy.is_new(RequestId(9, 2))
