"""What the worlds of ordered services have in common: replicas with a service under each, letters
that are lost, repeated and reordered, and what callers asked. Each step does one thing, chosen by
whoever drives the world. Not here: who orders (`ordering_world`).
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

from fogft.model.refusal import Refusal
from fogft.ordering.orders import Op
from fogft.ordering.replica import Begin, Refuse, Reply
from tests.ordering.linearizability import Call, Step, linearizable

S = TypeVar("S")


def lost(sent: S) -> Refuse[S]:
    """Return what the sender of a lost letter is told."""
    return Refuse(sent, Refusal.LOST)


@dataclass(eq=False)
class Letter(Generic[S]):
    """Something in the network: an order (to a replica), or its end (to who gave it)."""

    sent: S
    to_replica: bool
    payload: bytes | None = None
    refused: Refuse[S] | None = None


@dataclass
class Asked:
    """A call under way."""

    began: float
    asked: Any
    client: int


class Machine(Protocol):
    """The replica's part of the protocol."""

    serving: bool

    def done(self, serial: int, answer: bytes | None) -> list[Any]: ...

    def lost(self) -> list[Any]: ...


M = TypeVar("M", bound=Machine)


@dataclass(eq=False)
class Host(Generic[M]):
    """A replica: the machine in the middle, its service at the bottom."""

    replica: int
    machine: M
    state: Any
    work: Begin | None = None
    applied: list[Any] = field(default_factory=list)


class ServiceWorld(Generic[S, M]):
    """Replicas, a network, and a history of what callers saw.

    Args:
        step: The service: state and question in, next state and answer out.
        start: The service's first state.
    """

    def __init__(self, step: Step, start: Any) -> None:
        self.step, self.start = step, start
        self.now = 0.0
        self.letters: list[Letter[S]] = []
        self.history: list[Call] = []
        self.questions: dict[bytes, Any] = {}
        self.hosts: dict[int, Host[M]] = {}
        self.next_replica = 0
        self.restored = 0

    # -- network --------------------------------------------------------------------------

    def deliver(self, at: int, *, keep: bool = False) -> None:
        """Let a letter arrive; with `keep` it will arrive once more."""
        letter = self.letters[at]
        if not keep:
            self.letters[at] = self.letters[-1]
            self.letters.pop()
        if letter.to_replica:
            self.arrive(letter.sent)
        else:
            self.end(letter.sent, letter.payload, letter.refused)

    def lose(self, at: int) -> None:
        """The sender is told that a letter was lost: it may arrive all the same."""
        self.end(self.letters[at].sent, None, lost(self.letters[at].sent))

    def arrive(self, sent: S) -> None:
        """An order comes to its replica."""
        raise NotImplementedError

    def end(self, sent: S, payload: bytes | None, refused: Refuse[S] | None) -> None:
        """An order ends at who gave it."""
        raise NotImplementedError

    # -- services -------------------------------------------------------------------------

    def begin_process(self, replica: int, machine: M) -> None:
        machine.serving = True
        self.hosts[replica] = Host(replica, machine, self.start)

    def crash_service(self, replica: int) -> None:
        """The service dies and starts anew, in its first state."""
        host = self.hosts[replica]
        host.work, host.state, host.applied = None, self.start, []
        self.effects(host, host.machine.lost())
        host.machine.serving = True

    def effects(self, host: Host[M], effects: list[Any]) -> None:
        for effect in effects:
            if isinstance(effect, Reply):
                self.letters.append(Letter(effect.to, False, effect.payload))
            elif isinstance(effect, Refuse):
                self.letters.append(Letter(effect.to, False, None, effect))
            else:
                assert host.work is None, "the service was given two things at once"
                host.work = effect

    def working(self) -> list[int]:
        return [replica for replica, host in self.hosts.items() if host.work is not None]

    def work(self, replica: int) -> None:
        """The service ends what it does."""
        host = self.hosts[replica]
        begun, host.work = host.work, None
        assert begun is not None
        answer: bytes | None
        if begun.op is Op.APPLY:
            answer = repr(self.apply(host, begun.payload)).encode()
        elif begun.op is Op.SNAPSHOT:
            answer = repr((host.state, host.applied)).encode()
        else:
            self.restored += 1
            host.state, host.applied = eval(begun.payload.decode())
            answer = b""
        self.effects(host, host.machine.done(begun.serial, answer))

    def apply(self, host: Host[M], payload: bytes) -> Any:
        """Have a service take a request; return its answer."""
        host.state, answer = self.step_of(host.replica)(host.state, self.questions[payload])
        host.applied.append(payload)
        return answer

    def step_of(self, replica: int) -> Step:
        """Return what the service of a replica does."""
        return self.step

    # -- the end --------------------------------------------------------------------------

    def at_rest(self) -> bool:
        """Whether all is answered that will be, and all replicas are in one state."""
        raise NotImplementedError

    def check(self) -> None:
        """Callers saw one service, and the replicas, at rest, are in one state."""
        answered = [call for call in self.history if call.answered]
        assert linearizable(self.history, self.step, self.start), [*map(str, answered)]
        if self.at_rest():
            assert len({(repr(h.state), repr(h.applied)) for h in self.hosts.values()}) == 1

    def answers(self) -> Sequence[Any]:
        """Return what callers were answered, in that order."""
        return [call.answer for call in self.history if call.answered]


# -- questions ----------------------------------------------------------------------------------


def ask_counter(source: random.Random) -> tuple[str, int]:
    return ("add", source.randint(1, 9)) if source.random() < 0.7 else ("get", 0)


def ask_key_value(source: random.Random) -> tuple[Any, ...]:
    key = source.choice("abc")
    return ("put", key, source.randint(0, 99)) if source.random() < 0.6 else ("get", key)
