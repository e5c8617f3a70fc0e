"""A replica under every order that a sequencer may ever have sent, in any order, any number of
times: whatever comes, its state is the one that its position names.
"""

from __future__ import annotations

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from fogft.model.refusal import Refusal
from fogft.ordering import orders
from fogft.ordering.orders import Op, Position
from fogft.ordering.replica import Begin, OrderedReplica, Refuse, Reply
from tests.nightly import by_day

NUMBERS = st.integers(1, 6)
STATES = st.integers(0, 6)


class Replica(RuleBasedStateMachine):
    """One term with a fixed history: request n is the byte n, a state is the requests applied."""

    epoch = orders.next_epoch(0, 1)

    def __init__(self) -> None:
        super().__init__()
        self.machine: OrderedReplica[int] = OrderedReplica()
        self.machine.queue_limit, self.machine.kept_limit = 3, 2
        self.machine.serving = True
        self.state = b""
        self.begun: Begin | None = None
        self.orders: dict[int, tuple[Op, int]] = {}
        self.ended: set[int] = set()

    def give(self, op: Op, index: int, payload: bytes = b"", epoch: int | None = None) -> None:
        number = len(self.orders)
        self.orders[number] = (op, index)
        self.do(self.machine.order(op, epoch or self.epoch, index, payload, robot="r", to=number))

    def do(self, effects) -> None:
        for effect in effects:
            if isinstance(effect, Begin):
                assert self.begun is None, "the service does one thing at a time"
                self.begun = effect
                continue
            assert effect.to not in self.ended, "an order is answered once"
            self.ended.add(effect.to)
            op, index = self.orders[effect.to]
            if isinstance(effect, Reply) and op in (Op.APPLY, Op.RECALL):
                assert effect.payload == b"answer %d" % index
            elif isinstance(effect, Reply) and op is Op.SNAPSHOT:
                at, state = orders.decode_snapshot(effect.payload)
                assert state == bytes(range(1, at + 1))
            elif isinstance(effect, Refuse) and op is Op.APPLY:
                expected = (
                    orders.read_index(effect.detail) if effect.reason is Refusal.GAP else None
                )
                assert expected is None or expected <= 7

    @rule()
    def claim(self) -> None:
        self.give(Op.CLAIM, 0)

    @rule()
    def claim_of_an_earlier_term(self) -> None:
        self.give(Op.CLAIM, 0, epoch=1)

    @rule(index=STATES)
    def join(self, index: int) -> None:
        at = Position(self.epoch if index else 0, index)
        self.give(Op.JOIN, index, orders.encode_join(at, 0))

    @rule(index=STATES)
    def restore(self, index: int) -> None:
        state = bytes(range(1, index + 1))
        self.give(Op.RESTORE, index, orders.encode_snapshot(0, state))

    @rule(index=NUMBERS)
    def apply(self, index: int) -> None:
        self.give(Op.APPLY, index, bytes([index]))

    @rule(index=NUMBERS)
    def recall(self, index: int) -> None:
        self.give(Op.RECALL, index)

    @rule()
    def snapshot(self) -> None:
        self.give(Op.SNAPSHOT, 0)

    @precondition(lambda self: self.begun is not None)
    @rule(succeeds=st.sampled_from([True, True, True, False]))
    def work_is_done(self, succeeds: bool) -> None:
        begun, self.begun = self.begun, None
        assert begun is not None
        if begun.op is Op.APPLY:
            self.state += begun.payload
            answer: bytes | None = b"answer %d" % begun.payload[0]
        elif begun.op is Op.SNAPSHOT:
            answer = self.state if succeeds else None
        else:
            self.state = begun.payload if succeeds else b"half"
            answer = b"" if succeeds else None
        self.do(self.machine.done(begun.serial, answer))

    @rule()
    def crash(self) -> None:
        self.begun, self.state = None, b""
        self.do(self.machine.lost())
        self.machine.serving = True

    @invariant()
    def the_state_is_that_of_the_position(self) -> None:
        if self.machine.sound:
            assert self.state == bytes(range(1, self.machine.position.index + 1))
        if self.machine.joined:
            assert self.machine.sound
            assert self.machine.position.epoch == self.epoch

    @invariant()
    def nothing_waits_for_nothing(self) -> None:
        if self.begun is None:
            assert self.ended == self.orders.keys()


TestReplica = Replica.TestCase
TestReplica.settings = settings(
    max_examples=by_day(60, at_night=1000), stateful_step_count=40, deadline=None
)


def test_a_second_restore_does_not_leave_requests_of_the_first_in_the_queue():
    """An older copy arrives while the newer restore runs: it is behind, and is left alone."""
    machine: OrderedReplica[str] = OrderedReplica()
    machine.serving = True
    epoch = orders.next_epoch(0, 1)

    def order(op: Op, index: int, payload: bytes = b"", to: str = "") -> list:
        return machine.order(op, epoch, index, payload, robot="r", to=to)

    order(Op.CLAIM, 1)
    [first] = order(Op.RESTORE, 15, orders.encode_snapshot(15, b"new"))
    assert order(Op.RESTORE, 11, orders.encode_snapshot(15, b"old"), to="old") == []
    effects = machine.done(first.serial, b"")
    assert Reply("old", orders.encode_index(16)) in effects
    assert not any(isinstance(effect, Begin) for effect in effects)
    [applied] = order(Op.APPLY, 16, b"q")
    assert (applied.op, machine.position.index) == (Op.APPLY, 15)
