"""``python -m tests.soak --minutes N``: damage a pool without end, and see that nobody notices.

Ends with status 0 where every kind of fault was done, no request failed, none was answered wrongly,
and no server proxy ran a request twice; else with 1, and says what went wrong.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.estimates import median, p99
from tests.link.namespaces import can_make_namespaces
from tests.link.wire_pool import wait_for
from tests.proxy.gateway_pool import ran
from tests.soak import robot, schedule
from tests.soak.clocks import can_set
from tests.soak.damage import do
from tests.soak.load import CALM, Load
from tests.soak.verdict import Outcome, faults_found
from tests.soak.world import LIMIT_S, World, made

LONG_MIN = 10  # so many minutes have time for the faults that take a minute
UPLINKS = ("failover", "prefer", "all")


def main() -> int:
    """Run; return the exit status."""
    parser = argparse.ArgumentParser(prog="scripts/soak", description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="how long (default 10)")
    parser.add_argument("--seed", type=int, default=1, help="of the schedule (default 1)")
    parser.add_argument("--keep", type=Path, help="folder for what the processes write")
    parser.add_argument("--robot", action="store_true", help="the robot's own side, under ROS")
    parser.add_argument("--only", action="append", help="with --robot: this kind of fault")
    given = parser.parse_args()
    nightly = given.minutes >= LONG_MIN
    if given.robot:
        if not given.only:
            print("not run: clock set: give `--only 'clock set'`, it needs UDP", file=sys.stderr)
        if not can_make_namespaces():
            parser.error("--robot needs root: it mounts disks of its own")
        with tempfile.TemporaryDirectory(prefix="fogft-soak-") as folder:
            where = (given.keep or Path(folder)).resolve()
            where.mkdir(parents=True, exist_ok=True)
            kinds = given.only or robot.kinds(nightly=nightly)
            return robot.soak(where, given.seed, 60.0 * given.minutes, kinds)
    kinds, namespaces = list(schedule.KINDS), can_make_namespaces()
    if not namespaces:
        kinds = [kind for kind in kinds if "uplink" not in kind]
        print("not run: faults of uplinks: need root and `ip`, for namespaces", file=sys.stderr)
    if not can_set():
        kinds.remove("clock set")
        print("not run: clock set: needs gcc", file=sys.stderr)
    if not nightly:
        kinds = [kind for kind in kinds if kind not in schedule.NIGHTLY]
    with tempfile.TemporaryDirectory(prefix="fogft-soak-") as folder:
        where = given.keep or Path(folder)
        where.mkdir(parents=True, exist_ok=True)
        uplinks = UPLINKS[given.seed % len(UPLINKS)]
        with made(where, namespaces=namespaces, uplinks=uplinks) as world:
            loads: dict[str, Load] = {}
            done: Counter[str] = Counter()
            trouble = ""
            try:
                run(world, kinds, given.seed, 60.0 * given.minutes, loads, done)
            except AssertionError as error:  # what was awaited never came
                trouble = str(error)
            return judge(world, loads, done, kinds, trouble, given.seed)


def run(
    world: World,
    kinds: Sequence[str],
    seed: int,
    lasts_s: float,
    loads: dict[str, Load],
    done: Counter[str],
) -> None:
    """Damage the pool under load, every kind at least once; note the load and what was done."""
    world.wait_whole(lambda name: world.robots[name].tell()["report"])
    loads.update({name: Load(name, robot, seed) for name, robot in world.robots.items()})
    wait_for(lambda: all(load.told for load in loads.values()), LIMIT_S)
    end = time.monotonic() + lasts_s
    for fault in schedule.faults(seed, kinds):
        if time.monotonic() >= end and len(done) == len(kinds):
            break
        print(f"{fault.kind}, {fault.lasts_s} s", file=sys.stderr, flush=True)
        for load in loads.values():
            load.during = fault.kind
        do(world, fault)
        world.wait_whole(lambda name: _report(loads[name]))
        done[fault.kind] += 1
        for load in loads.values():
            load.during = CALM
        time.sleep(0.5)


def _report(load: Load) -> Mapping[str, Any]:
    return dict(load.told["report"])


def judge(
    world: World,
    loads: Mapping[str, Load],
    done: Counter[str],
    kinds: Sequence[str],
    trouble: str,
    seed: int,
) -> int:
    """Say what came of it; return the exit status."""
    for load in loads.values():
        with contextlib.suppress(AssertionError):  # what has no answer by then is counted
            wait_for(load.ended, LIMIT_S)
    counts = ran(world.folder)
    outcome = Outcome(
        asked=sum(load.told["asked"] for load in loads.values()),
        right=sum(load.told["right"] for load in loads.values()),
        wrong=[number for load in loads.values() for number in load.told["wrong"]],
        silent=sum(load.count("silent") + load.count("turned_away") for load in loads.values()),
        twice=world.ran_twice(),
        ran=len({number for numbers in counts.values() for number in numbers}),
        done=done,
        trouble=trouble,
    )
    show(outcome, loads, seed)
    why = faults_found(outcome, kinds)
    for line in why:
        print(f"FAILED: {line}")
    return 1 if why else 0


def show(outcome: Outcome, loads: Mapping[str, Load], seed: int) -> None:
    """Print how long requests took, by the fault that there was when they were asked."""
    robots, done = len(loads), outcome.done
    print(f"seed {seed}: {outcome.asked} requests of {robots} robots, {sum(done.values())} faults")
    print(f"{'fault':<22}{'times':>6}{'requests':>10}{'p50':>10}{'p99':>10}{'longest':>10}")
    for kind in (CALM, *done):
        took = sorted(t for load in loads.values() for t in load.took.get(kind, ()))
        if took:
            cells = (median(took), p99(took), took[-1])
            times = "".join(f"{1e3 * s:>7.0f} ms" for s in cells)
            print(f"{kind:<22}{done.get(kind, ''):>6}{len(took):>10}{times}")
    print(
        f"failed {outcome.failed}, wrong {len(outcome.wrong)}, unanswered in time "
        f"{outcome.silent}, run twice {len(outcome.twice)}, server proxies' own count {outcome.ran}"
    )


if __name__ == "__main__":
    sys.exit(main())
