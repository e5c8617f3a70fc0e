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
from fogft.proxy.replica.responder import Responder
from fogft.proxy.robot.dispatcher import Dispatcher
from fogft.requests.load import Handling, Load

UID = "0123456789abcdef"
TICK_S = 0.02
TELL_S = 0.1  # until a replica is told what is not wanted any more: as the dispatcher
KILLS = b"kills"  # a request that ends whatever process works on it, so long after it began:
KILLS_AFTER_S = 0.005
RESTART_S = 1.0  # until a service that has died answers again

ServiceTime = Callable[[random.Random], float]


def lognormal(median_s: float, sigma: float, stalls: float = 0.0, stall_s: float = 2.0):
    """Return service times: lognormal, and a share of requests that stall for longer."""

    def sample(source: random.Random) -> float:
        stalled = stall_s if source.random() < stalls else 0.0
        return stalled + median_s * source.lognormvariate(0.0, sigma)

    return sample


class Draws:
    """Random numbers that depend on the request and on how often it has run, not on where."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._runs: dict[bytes, int] = {}

    def __call__(self, payload: bytes) -> random.Random:
        run = self._runs[payload] = self._runs.get(payload, 0) + 1
        return random.Random(f"{self._seed} {payload!r} {run}")


class SimulatedService:
    """A service that works on all its requests at once, or on one after the other."""

    def __init__(self, world: World, service_time: ServiceTime, seed: int, *, serial: bool) -> None:
        self.world = world
        self.service_time = service_time
        self.serial = serial
        self.source = random.Random(seed)
        self.draws: Draws | None = None  # in place of the source
        self.pace: Callable[[float], float] = lambda now: 1.0  # how many times as long it takes
        self.free_at = 0.0
        self.hangs_until = 0.0
        self.ran = 0
        self.lives = 0
        self.dies: Callable[[], None] = lambda: None

    def call(self, payload: bytes, on_response: Callable[[bytes], None]) -> int:
        self.ran += 1
        now = max(self.world.now, self.hangs_until)
        source = self.source if self.draws is None else self.draws(payload)
        begun, life = max(now, self.free_at) if self.serial else now, self.lives
        self.free_at = end = begun + self.service_time(source) * self.pace(begun)
        if payload == KILLS:
            self.world.at(begun + KILLS_AFTER_S, lambda: self._die(life))
        else:
            self.world.at(end, lambda: self._end(payload, life, on_response))
        return self.ran

    def _die(self, life: int) -> None:
        if life == self.lives:
            self.lives, self.free_at = life + 1, self.world.now + RESTART_S
            self.dies()

    def _end(self, payload: bytes, life: int, on_response: Callable[[bytes], None]) -> None:
        if life != self.lives:
            return
        if self.world.now < self.hangs_until:  # it hung while it was at this
            self.world.at(self.hangs_until, lambda: on_response(payload))
        else:
            on_response(payload)

    def forget(self, ticket: int) -> None:
        pass


class SimulatedIncoming:
    """A request at a replica, whose answer travels back."""

    def __init__(self, link: SimulatedLink, id: bytes, payload: bytes, handling: Handling) -> None:
        self.service, self.robot, self.remaining_s = "/s", link.world.robot, link.world.timeout_s
        self.request_id, self.payload, self.handling = id, payload, handling
        self._link: SimulatedLink | None = link

    def reply(self, payload: bytes, *, load: Load | None = None, more: bool = False) -> None:
        self._answer(Answer(self.request_id, payload, service="/s", load=load))

    def refuse(self, reason: Refusal, detail: str = "", *, load: Load | None = None) -> None:
        self._answer(Answer(self.request_id, refusal=reason, service="/s", load=load))

    def _answer(self, answer: Answer) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.comes_back(answer)


class SimulatedLink:
    """A link to a replica: the real responder before a simulated service."""

    def __init__(self, world: World, replica: SimulatedReplica, slot: int, rtt_s: float) -> None:
        self.peer = Peer(ReplicaId(UID, slot, 1), f"h{slot}:1", f"replica.{slot}")
        self.world = world
        self.replica = replica
        self.rtt_s = rtt_s
        self.ready = frozenset({"/s"})
        self.usable, self.leaving, self.thin = True, False, False
        self.open: set[bytes] = set()
        self.forgotten: set[bytes] = set()
        self.offers = 0

    @property
    def frozen(self) -> bool:
        return self.replica.frozen

    @frozen.setter
    def frozen(self, value: bool) -> None:
        self.replica.frozen = value

    @property
    def source(self) -> random.Random:
        return self.replica.service.source

    def offer(
        self,
        service: str,
        request_id: bytes,
        payload: bytes,
        remaining_s: float,
        *,
        more: bool = False,
        handling: Handling = Handling.NORMAL,
    ) -> bool:
        if not self.usable or request_id in self.open:
            return False
        self.offers += 1
        self.open.add(request_id)
        incoming = SimulatedIncoming(self, request_id, payload, handling)
        incoming.remaining_s = remaining_s - min(self.rtt_s, remaining_s / 2)
        self.world.at(self.world.now + self.rtt_s / 2, lambda: self._arrives(incoming))
        lost = Answer(request_id, refusal=Refusal.LOST, service="/s")
        self.world.at(self.world.now + remaining_s, lambda: self._end(lost))
        return True

    def _arrives(self, incoming: SimulatedIncoming) -> None:
        if self.usable and not self.frozen:
            self.replica.responder.request(incoming)

    def comes_back(self, answer: Answer) -> None:
        if self.usable and not self.frozen:
            self.world.at(self.world.now + self.rtt_s / 2, lambda: self._end(answer))

    def _end(self, answer: Answer) -> None:
        if answer.request_id in self.open:
            self.open.discard(answer.request_id)
            self.world.dispatcher.answered(self, answer)
        elif answer.request_id in self.forgotten:
            self.forgotten.discard(answer.request_id)
            self.world.dispatcher.late(self, answer)

    def send(self) -> None:
        pass

    def lose(self) -> None:
        """The link is suspect: what is open on it is lost."""
        self.usable = False
        self.forgotten.clear()
        for request in list(self.open):
            self._end(Answer(request, refusal=Refusal.LOST, service="/s"))
        self.world.route()

    def forget(self, request_id: bytes) -> None:
        if request_id in self.open:
            self.open.discard(request_id)
            self.forgotten.add(request_id)
            told = self.world.now + TELL_S + self.rtt_s / 2
            self.world.at(told, lambda: self._cancel(request_id))

    def _cancel(self, request_id: bytes) -> None:
        if request_id in self.forgotten and self.usable and not self.frozen:
            self.replica.responder.cancel([request_id])

    def flush(self) -> None:
        pass

    def status(self) -> LinkStatus:
        return LinkStatus(LinkState.UP, None, 0.0, 0.0, 0.001, 0, 0, "")

    def close(self) -> None:
        self.usable = False


class SimulatedReplica:
    """A service with the real responder before it; several robots may have links to it."""

    def __init__(
        self, world: World, service_time: ServiceTime, seed: int, *, serial: bool = False
    ) -> None:
        self.world = world
        self.service = SimulatedService(world, service_time, seed, serial=serial)
        self.service.dies = self._service_died
        self.responder = Responder(lambda name: self.ready, clock=lambda: world.now)
        self.responder.use({"/s": self.service})
        self.frozen = False
        self.deaths: list[float] = []  # of its service
        self._tick()

    @property
    def ready(self) -> bool:
        return not self.deaths or self.world.now >= self.deaths[-1] + RESTART_S

    def _service_died(self) -> None:
        self.deaths.append(self.world.now)
        self.responder.crashed()
        for after_s in (TELL_S, RESTART_S):
            self.world.at(self.world.now + after_s, self.world.route)

    def _tick(self) -> None:
        if not self.frozen:
            self.responder.tick()
        self.world.at(self.world.now + 0.1, self._tick)


class Timeline:
    """Simulated time, and what happens in it."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.ids = random.Random(5)
        self.robots = 0
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()

    def at(self, when: float, what: Callable[[], None]) -> None:
        heapq.heappush(self._events, (when, next(self._order), what))

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while self._events and self._events[0][0] <= end:
            self.now, _, what = heapq.heappop(self._events)
            what()
        self.now = end


class World:
    """Time, replicas, and one robot's dispatcher. Responses are kept with their moments.

    Args:
        hedging: The policy.
        timeout_s: Of each request.
        beside: Another robot's world, whose time and replicas this one shares.
    """

    def __init__(
        self,
        hedging: HedgingMode,
        *,
        timeout_s: float = 10.0,
        beside: World | None = None,
    ) -> None:
        self.time = Timeline() if beside is None else beside.time
        self.time.robots += 1
        self.robot = f"robot{self.time.robots}"
        self.timeout_s = timeout_s
        self.links: list[SimulatedLink] = []
        self.asked: dict[int, float] = {}
        self.answers: list[tuple[int, float, bytes]] = []
        self.spec = ServiceSpec("/s", "t/srv/T", timeout_s=timeout_s, hedging=hedging)
        self.dispatcher = Dispatcher(
            self.spec,
            lambda handle, payload: self.answers.append((handle, self.now, payload)),
            wake=self._wake,
            clock=lambda: self.now,
        )
        self._tick_at = self.now
        self._tick()
        for link in () if beside is None else beside.links:
            self.links.append(SimulatedLink(self, link.replica, len(self.links), link.rtt_s))
        self.route()

    @property
    def now(self) -> float:
        return self.time.now

    def replica(
        self, service_time: ServiceTime, *, serial: bool = False, rtt_s: float = 0.002
    ) -> SimulatedLink:
        slot = len(self.links)
        replica = SimulatedReplica(self, service_time, slot, serial=serial)
        link = SimulatedLink(self, replica, slot, rtt_s)
        self.links.append(link)
        self.route()
        return link

    def route(self) -> None:
        able: list[Link] = [link for link in self.links if link.usable and link.replica.ready]
        self.dispatcher.route(able)

    def change(self, hedging: HedgingMode) -> None:
        self.spec = replace(self.spec, hedging=hedging)
        self.dispatcher.adopt(self.spec)

    def at(self, when: float, what: Callable[[], None]) -> None:
        self.time.at(when, what)

    def _wake(self, at: float = 0.0) -> None:
        if at < self._tick_at:
            self._plan_tick(max(at, self.now))

    def _plan_tick(self, when: float) -> None:
        self._tick_at = when
        self.at(when, lambda: self._tick() if self._tick_at == when else None)

    def _tick(self) -> None:
        self._plan_tick(max(self.now, min(self.now + TICK_S, self.dispatcher.tick())))

    def ask(self) -> int:
        number = len(self.asked)
        self.asked[number] = self.now
        id = self.time.ids.randbytes(16)  # which the policy takes its chances by
        self.dispatcher.forward(id, b"%d" % number, number, self.timeout_s)
        return number

    def kill(self) -> None:
        """Send a request that kills; nobody waits for its answer."""
        self.dispatcher.forward(self.time.ids.randbytes(16), KILLS, -1, self.timeout_s)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        self.time.run(seconds)

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
