"""The lower bound of cost for replicas that are always ready, with perfect foresight.

A machine that serves was ordered one boot earlier, in a location with room since then, and its boot
is paid for. All else is free: a machine that is not needed ends at once. So replicas are units of a
flow through time, each in some location or on demand, and the cheapest flow is the bound.

Owns: the flow. Not here: what policies reach (`comparison`).
"""

import heapq
import itertools
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from fogft.simulation.timeline import Timeline

HOUR_S = 3600.0


class _Stay(NamedTuple):
    """A period in which a number of machines of one price can serve in one location."""

    begin_s: float
    end_s: float
    usd_per_hour: float
    machines: int


def least_usd_per_hour(
    timelines: Mapping[str, Timeline],
    spot: Mapping[str, float],
    on_demand: float | None,
    replicas: int,
    *,
    boot_s: float,
    length_s: float,
) -> float | None:
    """Return the lowest average cost of `replicas` always ready; None if impossible.

    Args:
        timelines: Location -> its room for spot machines.
        spot: Location -> US dollars per hour of a spot machine there.
        on_demand: US dollars per hour of an on-demand machine, always available; None for none.
        boot_s: From the order until a machine serves. The first machines are charged for it, too.
    """
    stays = [
        stay
        for place, usd in spot.items()
        if place in timelines
        for stay in _stays(timelines[place].window(0.0, length_s), usd, replicas, boot_s)
    ]
    if on_demand is not None:
        stays.append(_Stay(0.0, length_s, on_demand, replicas))
    usd = _Flow(stays, boot_s, length_s).cheapest(replicas)
    return None if usd is None else usd / (length_s / HOUR_S)


def _stays(line: Timeline, usd: float, most: int, boot_s: float) -> Iterator[_Stay]:
    layers = Counter(tuple(line.spells(level)) for level in range(1, most + 1))
    for spells, machines in layers.items():
        for has_room, begin, end in spells:
            ready = begin + boot_s if begin > 0 else 0.0
            if has_room and ready < end:
                yield _Stay(ready, end, usd, machines)


class _Flow:
    """Min-cost flow by successive cheapest paths through time; exact, as no cost is negative."""

    def __init__(self, stays: Sequence[_Stay], boot_s: float, length_s: float) -> None:
        ends = (at for stay in stays for at in (stay.begin_s, stay.end_s))
        times = sorted({0.0, length_s, *(at for at in ends if at < length_s)})
        index = {at: number for number, at in enumerate(times)}
        self._goal = len(times) - 1
        self._out: list[list[int]] = [[] for _ in times]
        self._to: list[int] = []  # by edge; each is followed by its reverse edge
        self._room: list[int] = []
        self._usd: list[float] = []
        for stay in stays:
            boot = stay.usd_per_hour * boot_s / HOUR_S
            first, last = index[stay.begin_s], index[min(stay.end_s, length_s)]
            before = None
            for number in range(first, last + 1):
                here = len(self._out)
                self._out.append([])
                if number < last:
                    self._edge(number, here, boot, stay.machines)
                self._edge(here, number, 0.0, stay.machines)
                if before is not None:
                    passed_s = times[number] - times[number - 1]
                    usd = stay.usd_per_hour * passed_s / HOUR_S
                    self._edge(before, here, usd, stay.machines)
                before = here

    def _edge(self, begin: int, end: int, usd: float, room: int) -> None:
        for to, at, cost, free in ((end, begin, usd, room), (begin, end, -usd, 0)):
            self._out[at].append(len(self._to))
            self._to.append(to)
            self._usd.append(cost)
            self._room.append(free)

    def cheapest(self, units: int) -> float | None:
        """Return the cost of the cheapest flow of this many units; None if there is none."""
        potential = [0.0] * len(self._out)
        total = 0.0
        while units:
            cost, by = self._paths(potential)
            if cost[self._goal] == math.inf:
                return None
            potential = [p + min(c, cost[self._goal]) for p, c in zip(potential, cost, strict=True)]
            path = []
            node = self._goal
            while node:
                path.append(by[node])
                node = self._to[by[node] ^ 1]
            pushed = min(units, *(self._room[edge] for edge in path))
            for edge in path:
                self._room[edge] -= pushed
                self._room[edge ^ 1] += pushed
            total += pushed * (potential[self._goal] - potential[0])
            units -= pushed
        return total

    def _paths(self, potential: Sequence[float]) -> tuple[list[float], list[int]]:
        cost = [math.inf] * len(self._out)
        by = [-1] * len(self._out)
        cost[0] = 0.0
        order = itertools.count()
        queue = [(0.0, next(order), 0)]
        while queue:
            usd, _, node = heapq.heappop(queue)
            if usd > cost[node]:
                continue
            if node == self._goal:
                break
            for edge in self._out[node]:
                if self._room[edge] > 0:
                    to = self._to[edge]
                    step = self._usd[edge] + potential[node] - potential[to]
                    found = usd + max(step, 0.0)
                    if found < cost[to] - 1e-12:
                        cost[to], by[to] = found, edge
                        heapq.heappush(queue, (found, next(order), to))
        return cost, by
