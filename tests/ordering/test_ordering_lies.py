"""One replica of a stateful service lies about the order: the others answer all the same."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from fogft.model.refusal import Refusal
from fogft.ordering import orders
from fogft.ordering.orders import INDEX_LIMIT, START, Op, OrderError, Position, Promise
from fogft.ordering.replica import Refuse, Reply
from fogft.ordering.sequencer import Sequencer
from tests.ordering.linearizability import counter
from tests.ordering.ordering_world import Letter, Sent, World

LIAR = 0
Says = Reply[Sent] | Refuse[Sent]
LATER = f"{1 << 40:x}"


class Lied(World):
    """A world in which one replica says of each order what a test wants."""

    says: Callable[[Sent], Says | None] | None = None
    to_liar = 0

    def arrive(self, sent: Sent) -> None:
        self.to_liar += sent.order.replica == LIAR
        said = self.says(sent) if self.says and sent.order.replica == LIAR else None
        if said is None:
            super().arrive(sent)
        elif isinstance(said, Reply):
            self.letters.append(Letter(sent, False, said.payload))
        else:
            self.letters.append(Letter(sent, False, None, said))

    def end(self, sent: Sent, payload: bytes | None, refused: Refuse[Sent] | None) -> None:
        try:
            super().end(sent, payload, refused)
        except OrderError:  # as the owner does with what it cannot read
            order = sent.order
            self.sequencer.refused(
                order.replica, order.op, order.index, Refusal.MALFORMED, self.now
            )
            self.send()


def fenced(epoch: str) -> Callable[[Sent], Says]:
    return lambda sent: Refuse(sent, Refusal.FENCED, epoch)


def promised(position: Position) -> Callable[[Sent], Says]:
    def says(sent: Sent) -> Says:
        if sent.order.op is Op.CLAIM:
            return Reply(sent, orders.encode_promise(Promise(position, sound=True)))
        return Refuse(sent, Refusal.CRASHED)

    return says


LIES = {
    "a later term": fenced(LATER),
    "the last term": fenced("f" * 16),
    "a term of its own": promised(Position(1 << 60, 5)),
    "the last number": promised(Position(0, INDEX_LIMIT - 1)),
    "a number beyond": promised(Position(0, (1 << 64) - 1)),
}


@pytest.mark.parametrize("lie", LIES)
@pytest.mark.parametrize("from_the_start", [True, False])
def test_what_one_replica_says_of_the_order_loses_no_answer(lie: str, from_the_start: bool) -> None:
    """Two of three are honest: each request is answered, by its number, in the first term."""
    world = Lied(counter, 0)
    if not from_the_start:
        world.settle()
    world.says = LIES[lie]
    for number in range(20):
        world.ask(0, ("add", 1))
        for _ in range(20):
            world.tick(0.05)
            while world.letters:
                world.deliver(0)
                for replica in world.working():
                    world.work(replica)
        assert len(world.history) == number + 1
    assert [call.answer for call in world.history] == list(range(1, 21))
    assert world.sequencer.mark == Position(world.epoch, 20)


@pytest.mark.parametrize("gap", [0, 1])
def test_a_replica_that_lacks_all_it_is_sent_is_not_sent_it_for_ever(gap: int) -> None:
    """It says of each request that an earlier one is missing: the robot's uplink is for others."""
    world = Lied(counter, 0)
    world.settle()
    world.says = lambda sent: (
        Refuse(sent, Refusal.GAP, str(gap)) if sent.order.op is Op.APPLY else None
    )
    for number in range(20):
        world.ask(0, ("add", 1))
        for _ in range(20):
            world.tick(0.05)
            for _ in range(50):  # so often to and fro in this time
                for _ in range(len(world.letters)):
                    world.deliver(0)
                for replica in world.working():
                    world.work(replica)
        assert len(world.history) == number + 1
    assert world.to_liar < 20 * 20


def test_an_honest_replica_that_orders_overtake_is_sent_them_again_at_once() -> None:
    """A large order is decompressed aside, and the small one after it comes first."""
    world = World(counter, 0, replicas=1)
    world.settle()
    before = world.now
    for _ in range(20):
        for client in (0, 1):
            world.ask(client, ("add", 1))
        while world.letters:
            world.deliver(-1)
            for replica in world.working():
                world.work(replica)
    assert len(world.history) == 40
    assert world.now == before


def test_a_term_ends_where_more_replicas_obey_a_later_one() -> None:
    """The file of terms was lost: two of three have obeyed one that it knows nothing of."""
    sequencer = Sequencer(5)
    sequencer.reach(range(3), 0.0)
    sequencer.refused(0, Op.CLAIM, 1, Refusal.FENCED, 0.0, detail=LATER)
    assert sequencer.deposed_by is None
    promise = orders.encode_promise(Promise(START, sound=True))
    sequencer.replied(2, Op.CLAIM, 3, promise)
    sequencer.refused(1, Op.CLAIM, 2, Refusal.FENCED, 0.0, detail=LATER)
    assert sequencer.deposed_by == int(LATER, 16)


def test_the_only_replica_is_believed_while_no_number_was_given() -> None:
    sequencer = Sequencer(5)
    sequencer.reach([0], 0.0)
    sequencer.refused(0, Op.CLAIM, 1, Refusal.FENCED, 0.0, detail=LATER)
    assert sequencer.deposed_by == int(LATER, 16)


def test_no_claimed_term_leaves_none_for_the_next() -> None:
    """Whatever is believed, there is a later one."""
    assert orders.read_epoch("f" * 16) is None
    believed = orders.read_epoch("7" + "f" * 15)
    assert believed is not None
    for _ in range(1000):
        believed = orders.next_epoch(believed, 7)
