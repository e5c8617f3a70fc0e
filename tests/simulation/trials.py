"""Markets that are hard on a planner, and the policies in them side by side.

    python -m tests.simulation.trials [--markets nine,cpu] [--policies 'fogft;naive'] [--days 30]

prints what each policy reaches and costs, in units of one on-demand machine. A spot machine costs
0.3 of it; two replicas with fallback; a boot takes 180 s and the cloud's answer 28 s.
"""

from __future__ import annotations

import argparse
import random
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from multiprocessing import Pool as Processes
from typing import Any, NamedTuple

from fogft.model.choices import OnDemandSpec
from fogft.model.replica import Offer, Placement
from fogft.model.spec import PoolSpec, ServiceSpec
from fogft.simulation.comparison import BOUND, SETTLE_S, Scenario, bound, policies, unlogged
from fogft.simulation.meter import DAY_S, Outcome
from fogft.simulation.model import MarketModel, Timing
from fogft.simulation.timeline import UNLIMITED, Timeline, of_changes
from fogft.simulation.world import World

HOUR_S = 3600.0
SPOT_PRICE = 0.3
Lines = dict[str, Timeline]


class Kind(NamedTuple):
    """Zones that differ.

    Attributes:
        zones: Region -> how many zones it has.
        up_h: Mean time with room of the worst and of the best zone, in hours; the others between.
        down_h: Mean time without, likewise.
        together: Share of the losses that strike a whole region at one moment.
        scarcity: How much faster room is lost, and slower found, in a region's bad hours.
    """

    zones: Mapping[str, int]
    up_h: tuple[float, float]
    down_h: tuple[float, float]
    together: float = 0.05
    scarcity: float = 4.0

    @property
    def locations(self) -> list[str]:
        """Return all of them."""
        return [f"aws/{r}/{zone}" for r, n in self.zones.items() for zone in "abcdef"[:n]]


NINE = {"us-east-1": 3, "us-east-2": 3, "us-west-2": 3}
FOUR = {"us-east-1": 2, "us-west-2": 2}
KINDS = {
    "nine": Kind(NINE, (0.7, 10.5), (0.4, 3), 0.1, 1.5),
    "scarce": Kind(FOUR, (1, 8), (0.5, 3), 0.1, 2.0),
    "cpu": Kind({"us-west-2": 3}, (1.2, 5.3), (0.33, 0.42), scarcity=1.5),
    "tight": Kind({"us-east-1": 1, "us-west-2": 1}, (1.5, 3), (2, 5)),
    "rich": Kind(FOUR, (60, 200), (0.5, 2), together=0.02, scarcity=2.0),
    "regions": Kind(NINE, (5, 20), (0.5, 2), together=0.02),
    "hours without": Kind(NINE, (0.9, 12), (0.5, 4)),
    "flapping": Kind(FOUR, (0.2, 0.2), (0.133, 0.133)),
    "flapping fast": Kind(FOUR, (0.067, 0.067), (0.067, 0.067)),
}


def market(name: str, length_s: float, seed: int) -> Lines:
    """Return the timelines of a market."""
    kind, chance = KINDS[name], random.Random(f"{name} {seed}")
    if name.startswith("flapping"):
        on_s, off_s = kind.up_h[0] * HOUR_S, kind.down_h[0] * HOUR_S
        return {p: _flapping(chance, length_s, on_s, off_s) for p in kind.locations}
    lines = _unequal(kind, length_s, chance)
    if name == "regions":  # one goes as a whole every 20 h, for up to 4 h
        at = chance.expovariate(1 / (20 * HOUR_S))
        while at < length_s:
            region, end = chance.choice(list(kind.zones)), at + chance.uniform(0.3, 4) * HOUR_S
            lines = _closed(lines, at, end, lambda p, r=region: f"/{r}/" in p)
            at += chance.expovariate(1 / (20 * HOUR_S))
    if name == "hours without":  # no spot machine anywhere, every third day
        for begin in range(int(DAY_S), int(length_s), int(3 * DAY_S)):
            lines = _closed(lines, begin, begin + 6 * HOUR_S, lambda p: True)
    return lines


def _between(ends: tuple[float, float], count: int, chance: random.Random) -> list[float]:
    low, high = ends
    found = [low * (high / low) ** (i / max(count - 1, 1)) * HOUR_S for i in range(count)]
    chance.shuffle(found)
    return found


def _unequal(kind: Kind, length_s: float, chance: random.Random) -> Lines:
    places = kind.locations
    up_s = dict(zip(places, _between(kind.up_h, len(places), chance), strict=True))
    down_s = dict(zip(places, _between(kind.down_h, len(places), chance), strict=True))
    lines: Lines = {}
    for region in kind.zones:
        here = [p for p in places if f"/{region}/" in p]
        rate = kind.together * sum(1 / up_s[p] for p in here) / len(here)
        strikes = list(_times(chance, rate, length_s))
        regimes = list(_times(chance, 1 / (6 * HOUR_S), length_s))  # good and bad hours in turn
        bad_first = chance.random() < 0.3
        for place in here:
            changes, at = [], 0.0
            has_room = chance.random() < up_s[place] / (up_s[place] + down_s[place])
            while at < length_s:
                changes.append((at, UNLIMITED if has_room else 0))
                bad = bad_first ^ bool(bisect_right(regimes, at) % 2)
                factor = kind.scarcity if bad else 1.0
                mean_s = up_s[place] / factor if has_room else down_s[place] * factor
                end = at + chance.expovariate(1 / mean_s)
                if has_room:
                    later = strikes[bisect_right(strikes, at) :][:1]
                    end = min([end, *later])
                at = max(round(end / 60) * 60.0, at + 60.0)
                has_room = not has_room
            lines[place] = of_changes(changes, length_s)
    return lines


def _times(chance: random.Random, rate: float, length_s: float) -> Iterator[float]:
    at = chance.expovariate(rate)
    while at < length_s:
        yield at
        at += chance.expovariate(rate)


def _flapping(chance: random.Random, length_s: float, on_s: float, off_s: float) -> Timeline:
    at = chance.uniform(0.0, on_s + off_s)
    changes: list[tuple[float, int]] = [(0.0, UNLIMITED)]
    while at < length_s:
        changes += [(at, 0), (at + off_s, UNLIMITED)]
        at += on_s + off_s
    return of_changes([(at, n) for at, n in changes if at < length_s], length_s)


def _closed(lines: Lines, begin: float, end: float, where: Callable[[str], bool]) -> Lines:
    out = dict(lines)
    for place in filter(where, lines):
        line = lines[place]
        kept = [(at, n) for at, n in line.changes if not begin <= at <= end]
        after = [(end, line.capacity(end))] if end < line.length_s else []
        out[place] = of_changes(sorted([*kept, (begin, 0), *after]), line.length_s)
    return out


def sold(places: Sequence[str]) -> Callable[[Mapping[str, Any]], list[Offer]]:
    """Return what a cloud with these locations answers: the same prices everywhere."""
    offers = [
        Offer(Placement(*place.split("/"), "v100", spot), SPOT_PRICE if spot else 1.0)
        for place in places
        for spot in (True, False)
    ]
    return lambda resources: [o for o in offers if o.placement.spot == resources["use_spot"]]


class Trial(NamedTuple):
    """One policy in one market."""

    market: str
    policy: str
    replicas: int = 2
    notice_s: float = 120.0
    answer_s: float = 28.0
    days: float = 30.0
    seed: int = 0
    cap: float | None = None
    surge: int = 3


def run(trial: Trial) -> Outcome:
    """Return what comes of it."""
    task = {"run": "plan", "resources": {"use_spot": True}}
    pool = PoolSpec(
        "trial",
        (ServiceSpec("/plan", "nav_msgs/srv/GetPlan"),),
        replicas=trial.replicas,
        task=task,
        on_demand=OnDemandSpec(0, fallback=True),
        max_usd_per_hour=trial.cap,
        max_surge=trial.surge,
    )
    scenario = Scenario(
        pool,
        sold(KINDS[trial.market].locations),
        Timing(boot_s=180.0, notice_s=trial.notice_s, answer_s=trial.answer_s),
        MarketModel(),
        recorded=market(trial.market, SETTLE_S + trial.days * DAY_S, trial.seed),
        days=trial.days,
        seeds=(trial.seed,),
    )
    if trial.policy == BOUND:
        found = bound(scenario, scenario.market(trial.seed))
        assert found is not None
        return found
    length_s = scenario.length_s
    world = World(
        scenario.market(trial.seed), seed=trial.seed, length_s=length_s, settle_s=SETTLE_S
    )
    with unlogged():
        return world.run(policies(scenario)[trial.policy](world)).outcome()


def main() -> None:
    """Run what is asked for and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--markets", default=",".join(KINDS))
    parser.add_argument("--policies", default="fogft;naive;SpotHedge;omniscient")
    parser.add_argument("--replicas", type=int, default=2)
    parser.add_argument("--notice", default="0,120")
    parser.add_argument("--answer", type=float, default=28.0)
    parser.add_argument("--days", type=float, default=30.0)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--cap", type=float)
    parser.add_argument("--surge", type=int, default=3)
    given = parser.parse_args()
    trials = [
        Trial(
            m,
            p,
            given.replicas,
            float(notice),
            given.answer,
            given.days,
            seed,
            given.cap,
            given.surge,
        )
        for m in given.markets.split(",")
        for notice in given.notice.split(",")
        for p in given.policies.split(";")
        for seed in range(given.seeds)
    ]
    print("| market | notice | policy | available | cost | all ready | orders/day | losses/day |")
    print("|---|---|---|---|---|---|---|---|")
    with Processes(2) as processes:
        done = processes.imap(run, trials)
        for first in trials[:: given.seeds]:
            found = [next(done) for _ in range(given.seeds)]
            print(_row(first, found), flush=True)


def _row(trial: Trial, found: Sequence[Outcome]) -> str:
    def mean(figure: Callable[[Outcome], float]) -> float:
        return sum(map(figure, found)) / len(found)

    days = sum(o.seconds for o in found) / len(found) / DAY_S
    orders = mean(lambda o: o.launches + o.refusals) / days
    return (
        f"| {trial.market} | {trial.notice_s:.0f} | {trial.policy} | "
        f"{mean(lambda o: o.available):.5f} | {mean(lambda o: o.usd_per_hour):.3f} | "
        f"{1 - mean(lambda o: o.under_target):.4f} | {orders:.0f} | "
        f"{mean(lambda o: o.preemptions) / days:.1f} |"
    )


if __name__ == "__main__":
    main()
