"""How many requests a service is given at once, in virtual time: a learned limit, and one ahead."""

from __future__ import annotations

import pytest

from fogft.proxy.replica.responder import Responder
from fogft.requests.load import Handling
from tests.proxy.fakes import Clock, FakeClient, FakeIncoming

IN_FLIGHT = 20
LEARNED_AFTER = 600  # answers


class Service:
    """Answers `workers` requests at a time, in the order in which it was given them.

    There are always `IN_FLIGHT` requests. `idle` counts how often a worker had none.
    """

    def __init__(self, takes_s: float, workers: int = 1) -> None:
        self._takes_s, self._workers = takes_s, workers
        self.clock, self.client = Clock(), FakeClient()
        self.responder = Responder(lambda name: True, clock=self.clock)
        self.responder.use({"/s": self.client})
        self._ended = self._asked = self.idle = 0
        for _ in range(IN_FLIGHT):
            self.ask()

    def ask(self, handling: Handling = Handling.NORMAL) -> FakeIncoming:
        self._asked += 1
        incoming = FakeIncoming(self._asked.to_bytes(16, "big"), handling=handling)
        self.responder.request(incoming)
        return incoming

    def work(self, answers: int) -> None:
        until = self._ended + answers
        while self._ended < until:
            self.clock.now += self._takes_s
            begun = len(self.client.calls)  # what it is given from here on it begins later
            for _ in range(min(self._workers, begun - self._ended)):
                self.client.calls[self._ended][1](b"r")
                self._ended += 1
                self.ask()
            self.idle += max(0, self._workers - (begun - self._ended))


@pytest.fixture
def quick() -> Service:
    service = Service(0.02)
    service.work(LEARNED_AFTER)
    return service


def test_a_quick_service_has_its_next_request_before_it_ends_one(quick: Service) -> None:
    """So it never waits for the way from its answer to the next request."""
    before = quick.idle
    quick.work(1000)
    assert quick.responder.limits == {"/s": 1}
    # At a trial of the limit it is given no more than that, for 30 answers each.
    assert quick.idle - before <= 2 * 31
    assert quick.responder.at_work == 2


def test_one_that_takes_long_is_given_no_more_than_its_limit() -> None:
    service = Service(0.1)
    service.work(LEARNED_AFTER)
    assert service.responder.limits == {"/s": 1}
    assert service.responder.at_work == 1


def test_one_that_does_two_things_at_once_is_not_taken_for_one_that_does_not() -> None:
    service = Service(0.02, workers=2)
    service.work(2 * LEARNED_AFTER)
    limits = []
    for _ in range(1000):
        service.work(2)
        limits.append(service.responder.limits["/s"])
    assert sum(limit < 2 for limit in limits) <= 2 * 31  # at a trial


def test_a_spare_copy_does_not_go_ahead(quick: Service) -> None:
    spare = quick.ask(Handling.DROP_IF_BUSY)
    assert spare.outcome == ["refused busy"]


def test_one_ahead_that_is_lost_makes_room_for_another(quick: Service) -> None:
    quick.responder.crashed("/s")
    assert quick.responder.at_work == 0
    for _ in range(3):
        quick.ask()
    assert quick.responder.at_work == 2
