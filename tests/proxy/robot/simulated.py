"""A dispatcher before replicas with given service times, in simulated time: no thread, no clock."""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count

from fogft.link.port import Answer, Link, LinkStatus, Peer
from fogft.model.refusal import Refusal
from fogft.model.replica import LinkState, ReplicaId
from fogft.model.spec import HedgingMode, ServiceSpec
from fogft.proxy.robot.dispatcher import Dispatcher

UID = "0123456789abcdef"
TICK_S = 0.02

ServiceTime = Callable[[random.Random], float]


def lognormal(median_s: float, sigma: float, stalls: float = 0.0, stall_s: float = 2.0):
    """Return service times: lognormal, and a share of requests that stall for longer."""

    def sample(source: random.Random) -> float:
        stalled = stall_s if source.random() < stalls else 0.0
        return stalled + median_s * source.lognormvariate(0.0, sigma)

    return sample


class SimulatedLink:
    """A replica that works on all its requests at once, or on one after the other."""

    def __init__(
        self, world: World, slot: int, service_time: ServiceTime, *, serial: bool = False
    ) -> None:
        self.peer = Peer(ReplicaId(UID, slot, 1), f"h{slot}:1", f"replica.{slot}")
        self.world = world
        self.service_time = service_time
        self.serial = serial
        self.source = random.Random(slot)
        self.ready = frozenset({"/s"})
        self.usable, self.draining = True, False
        self.free_at = 0.0
        self.frozen = False
        self.open: dict[bytes, int] = {}
        self.offers = 0
        self._attempts = count()

    def offer(
        self,
        service: str,
        request_id: bytes,
        payload: bytes,
        remaining_s: float,
        *,
        more: bool = False,
    ) -> bool:
        if not self.usable or request_id in self.open:
            return False
        self.offers += 1
        attempt = self.open[request_id] = next(self._attempts)
        begin = max(self.world.now, self.free_at) if self.serial else self.world.now
        end = begin + self.service_time(self.source)
        self.free_at = end
        if not self.frozen:
            self.world.at(end, lambda: self._end(request_id, attempt, payload))
        self.world.at(self.world.now + remaining_s, lambda: self._end(request_id, attempt, None))
        return True

    def send(self) -> None:
        pass

    def _end(self, request: bytes, attempt: int, payload: bytes | None) -> None:
        if self.open.get(request) == attempt:
            del self.open[request]
            refusal = None if payload is not None else Refusal.LOST
            answer = Answer(request, payload=payload, refusal=refusal, service="/s")
            self.world.dispatcher.answered(self, answer)

    def lose(self) -> None:
        """The link is suspect: what is open on it is lost."""
        self.usable = False
        for request, attempt in list(self.open.items()):
            self._end(request, attempt, None)
        self.world.route()

    def forget(self, request_id: bytes) -> None:
        self.open.pop(request_id, None)

    def flush(self) -> None:
        pass

    def status(self) -> LinkStatus:
        return LinkStatus(LinkState.UP, None, 0.0, 0.0, 0.001, 0, 0, 0, "")

    def close(self) -> None:
        self.usable = False


class World:
    """Time, replicas, and one service's dispatcher. Responses are kept with their moments."""

    def __init__(self, hedging: HedgingMode, *, timeout_s: float = 10.0, budget: float = 0.1):
        self.now = 1000.0
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()
        self.links: list[SimulatedLink] = []
        self.asked: dict[int, float] = {}
        self.answers: list[tuple[int, float, bytes]] = []
        self.spec = ServiceSpec(
            "/s", "t/srv/T", timeout_s=timeout_s, hedging=hedging, hedging_budget=budget
        )
        self.dispatcher = Dispatcher(
            self.spec,
            lambda handle, payload: self.answers.append((handle, self.now, payload)),
            wake=self._wake,
            clock=lambda: self.now,
        )
        self._tick_at = self.now
        self._tick()

    def replica(self, service_time: ServiceTime, **options: bool) -> SimulatedLink:
        link = SimulatedLink(self, len(self.links), service_time, **options)
        self.links.append(link)
        self.route()
        return link

    def route(self) -> None:
        able: list[Link] = [link for link in self.links if link.usable]
        self.dispatcher.route(able)

    def change(self, hedging: HedgingMode) -> None:
        self.spec = replace(self.spec, hedging=hedging)
        self.dispatcher.adopt(self.spec)

    def at(self, when: float, what: Callable[[], None]) -> None:
        heapq.heappush(self._events, (when, next(self._order), what))

    def _wake(self) -> None:
        self._plan_tick(self.now)

    def _plan_tick(self, when: float) -> None:
        self._tick_at = when
        self.at(when, lambda: self._tick() if self._tick_at == when else None)

    def _tick(self) -> None:
        self._plan_tick(max(self.now, min(self.now + TICK_S, self.dispatcher.tick())))

    def ask(self) -> int:
        number = len(self.asked)
        self.asked[number] = self.now
        self.dispatcher.submit(b"%d" % number, number)
        return number

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while self._events and self._events[0][0] <= end:
            self.now, _, what = heapq.heappop(self._events)
            what()
        self.now = end

    def calls(self, requests: int, pause_s: float = 0.01) -> None:
        """Ask one after the other, as a caller that waits for each answer does."""
        for _ in range(requests):
            number = self.ask()
            before = len(self.answers)
            limit = self.now + self.spec.timeout_s + 1.0
            while not any(handle == number for handle, _, _ in self.answers[before:]):
                self.run(0.001)
                if self.now > limit:
                    break
            self.run(pause_s)

    def poisson(self, rate: float, seconds: float, source: random.Random) -> None:
        """Ask at random moments."""
        end = self.now + seconds
        while self.now < end:
            self.run(source.expovariate(rate))
            self.ask()

    def latencies(self, since: int = 0) -> list[float]:
        return [at - self.asked[n] for n, at, _ in self.answers if n >= since]

    def copies(self) -> float:
        return sum(link.offers for link in self.links) / len(self.asked)

    def shares(self) -> Iterator[float]:
        """Yield each replica's share of all copies."""
        total = sum(link.offers for link in self.links)
        return (link.offers / total for link in self.links)
