"""``scripts/soak --robot``: damage the robot's own side under a ROS client, and count what is lost.

A whole pool on the local cloud, started by `fogft up` and left alone: what is killed is started
again by whatever fogft has put there. Its folder lies on a small disk of its own.

Ends with status 0 where every kind of fault was done, nothing was answered wrongly or twice, and
nothing was lost but what the middleware loses (`MAY_LOSE_S`); else with 1, and says what was.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from fogft.disk import holder as lock_holder
from fogft.planning.observed.launches import HOUR_S, LAUNCHES_AN_HOUR
from fogft.pool.commands import status as seen
from fogft.pool.folder.paths import PoolPaths
from tests.conftest import lock_domain
from tests.e2e.pool import Client, Pool
from tests.estimates import p99
from tests.fakes.waiting import wait_for
from tests.proxy import breaking
from tests.soak.clocks import Clocks
from tests.soak.schedule import LONGEST_S, Fault, faults

REPLICAS = 2
RATE_HZ = 10.0
LIMIT_S = 400.0  # for whatever has to come about on a machine that is busy
TIMEOUT_S = 120.0  # of the service: longer than the longest suspend
LATE_S = 1.0
LONG_S = 60.0
SOON_S = 0.5
UNDER_WAY_S = 0.2  # a request, where nothing is amiss
TAKEN_S = 1.0  # what was asked so long before a kill may have been under way
PARTS = ("manager", "proxy", "standby", "spare")
DISK = "size=24m,mode=700"
MAY_LOSE_S = {
    # What a killed proxy had taken, and what was asked while no service was there to be asked.
    "kill proxy": SOON_S,
    "kill proxy twice": SOON_S,
    "kill manager, proxies": SOON_S,
    "kill all": float("inf"),
    # A client keeps its last ten requests for a service that takes none, as for any other service.
    "freeze proxy": float("inf"),
    # DDS takes those for gone of whom it has not heard for 20 s, until it hears of them again: a
    # plain service and its client lose one or two requests as well.
    "long suspend": LONG_S + LONGEST_S + 1.0,
}  # asked until so long after the fault began, or struck again


class World:
    """A robot with a pool, and a client that asks all the time.

    Args:
        folder: For everything that is written.
        domain: Its ROS domain.
        sets_clock: Whether the clock will be set. Fast DDS's shared memory does not outlive one
            that is set back: by it a port counts as abandoned. ROS has its defaults otherwise.
    """

    def __init__(self, folder: Path, domain: int, *, sets_clock: bool) -> None:
        self._clocks = Clocks(folder, one=True) if sets_clock else None
        self.pool = Pool(folder, domain)
        del self.pool.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"]
        if sets_clock:
            self.pool.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"
        self.pool.write(replicas=REPLICAS)
        text = self.pool.file.read_text().replace("timeout_s: 10.0", f"timeout_s: {TIMEOUT_S}")
        self.pool.file.write_text(text)
        pools = folder / "home" / "pools"
        pools.mkdir(parents=True, mode=0o700)
        subprocess.run(["mount", "-t", "tmpfs", "-o", DISK, "tmpfs", str(pools)], check=True)
        self._disk = pools
        self.paths = PoolPaths(pools / "e2e")
        self.ends = folder / "ends.jsonl"
        self.client: Client | None = None
        self._versions = 0
        self.during = Time("", 0.0)

    def up(self) -> None:
        self.pool.fogft("up", str(self.pool.file), "--yes", limit_s=LIMIT_S)

    def begin(self) -> None:
        """Start the pool and the client."""
        self.up()
        self.wait(self.whole, "whole")
        self.client = Client(self.pool.environ, 1e6, RATE_HZ, TIMEOUT_S + 30, str(self.ends))

    def update(self) -> None:
        """Apply a changed file: replicas are replaced one by one."""
        self._versions += 1
        text = self.pool.file.read_text()
        old, new = (
            f"plan_service.py 0.00{5 + n % 2}" for n in (self._versions - 1, self._versions)
        )
        assert old in text
        self.pool.file.write_text(text.replace(old, new))
        self.up()

    def pid(self, what: str) -> int:
        """Return the process of the `manager`, the `proxy`, the `standby` or the `spare`."""
        lock = getattr(self.paths, f"{what}_lock")
        return int(self.wait(lambda: lock_holder(lock), what))

    def parts(self) -> list[int]:
        return [self.pid(what) for what in PARTS]

    def whole(self) -> bool:
        """Whether all is as it was at the beginning, by what `fogft status` says."""
        told = seen.read(self.paths, time.time()).to_json()
        ready = sum(one["phase"] == "ready" for one in told["replicas"])
        return (
            ready == len(told["replicas"]) == REPLICAS
            and told["answers"] is True
            and told["manager_alive"]
            and lock_holder(self.paths.standby_lock) is not None
            and lock_holder(self.paths.spare_lock) is not None
        )

    def answered(self, asked: float) -> bool:
        """Whether a request was answered that was asked after this moment."""
        lines = self.ends.read_text().splitlines() if self.ends.exists() else []
        ends = (json.loads(line) for line in lines[-100:])
        return any(at is not None and when > asked for when, at, _ in ends)

    def wait(self, condition: Callable[[], object], what: str) -> object:
        told = partial(self.pool.fogft, "status", ok=False)
        return wait_for(condition, LIMIT_S, what, told=told, pause_s=0.05)

    def set_clock(self, ahead_s: int) -> None:
        """Set the clock of the robot, of which the local cloud's machines are a part."""
        assert self._clocks is not None
        self._clocks.set_all(ahead_s)

    def close(self) -> None:
        if self.client is not None and self.client.asking:
            self.client.kill()
        self.pool.close()
        subprocess.run(["umount", "--lazy", str(self._disk)], check=True)


Damage = Callable[[World, Fault], contextlib.AbstractContextManager[None]]


def _kill(*which: str) -> Damage:
    """Kill these at once: none of them has the time to react."""

    @contextlib.contextmanager
    def damage(world: World, fault: Fault) -> Iterator[None]:
        pids = [world.pid(what) for what in which]
        world.during.began = time.monotonic()  # on a busy machine the last may have come late
        for number in (signal.SIGSTOP, signal.SIGKILL):
            for pid in pids:
                os.kill(pid, number)
        yield

    return damage


@contextlib.contextmanager
def _kill_all(world: World, fault: Fault) -> Iterator[None]:
    """Kill all that is on the robot, which only a person or systemd mends."""
    with _kill(*PARTS)(world, fault):
        yield
    world.up()


@contextlib.contextmanager
def _kill_twice(world: World, fault: Fault) -> Iterator[None]:
    first = world.pid("proxy")
    world.during.began = time.monotonic()
    os.kill(first, signal.SIGKILL)
    world.wait(lambda: lock_holder(world.paths.proxy_lock) not in (first, None), "taken over")
    time.sleep(1.0)
    world.during.again.append(time.monotonic())
    os.kill(world.pid("proxy"), signal.SIGKILL)
    yield


@contextlib.contextmanager
def _terminate(world: World, fault: Fault) -> Iterator[None]:
    os.kill(world.pid("proxy"), signal.SIGTERM)
    yield


def _freeze(what: str) -> Damage:
    @contextlib.contextmanager
    def damage(world: World, fault: Fault) -> Iterator[None]:
        pid = world.pid(what)
        os.kill(pid, signal.SIGSTOP)
        yield
        os.kill(pid, signal.SIGCONT)

    return damage


def _broken(fault_of: breaking.Fault) -> Damage:
    @contextlib.contextmanager
    def damage(world: World, fault: Fault) -> Iterator[None]:
        with fault_of(world.paths.folder, world.parts()):
            yield

    return damage


@contextlib.contextmanager
def _clock_set(world: World, fault: Fault) -> Iterator[None]:
    world.set_clock(3600 if fault.victim % 2 else -3600)
    yield
    world.set_clock(0)


@contextlib.contextmanager
def _suspend(world: World, fault: Fault) -> Iterator[None]:
    """Stop everything, the client included, as a machine does that sleeps."""
    pids = world.pool.processes()
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    yield
    for pid in pids:
        os.kill(pid, signal.SIGCONT)


@contextlib.contextmanager
def _long_suspend(world: World, fault: Fault) -> Iterator[None]:
    before = world.pid("proxy")
    with _suspend(world, fault):
        time.sleep(LONG_S)
        yield
    # Whole again is a client proxy that DDS has not forgotten.
    world.wait(lambda: lock_holder(world.paths.proxy_lock) not in (before, None), "renewed")


def _rotate(role: str) -> Damage:
    @contextlib.contextmanager
    def damage(world: World, fault: Fault) -> Iterator[None]:
        world.pool.fogft("credentials", "rotate", role, limit_s=LIMIT_S)
        yield

    return damage


@contextlib.contextmanager
def _update(world: World, fault: Fault) -> Iterator[None]:
    world.update()
    yield


def _kill_replicas(count: int) -> Damage:
    @contextlib.contextmanager
    def damage(world: World, fault: Fault) -> Iterator[None]:
        told = seen.read(world.paths, time.time()).to_json()
        slots = sorted(one["slot"] for one in told["replicas"])
        for number in range(count):
            slot = slots[(fault.victim + number) % len(slots)]
            world.pool.fogft("chaos", "kill", str(slot))
        yield

    return damage


LAUNCHES = {
    "rotate replica": REPLICAS,
    "update": REPLICAS,
    "kill replica": 1,
    "kill all replicas": REPLICAS,
}
MAY_LAUNCH = LAUNCHES_AN_HOUR * REPLICAS - 2  # two may have to be replaced for another reason

DAMAGES: dict[str, Damage] = {
    "kill manager": _kill("manager"),
    "kill proxy": _kill("proxy"),
    "kill standby": _kill("standby"),
    "kill manager, standby": _kill("manager", "standby"),
    "kill proxy twice": _kill_twice,
    "kill manager, proxies": _kill("manager", "proxy", "standby"),
    "kill all": _kill_all,
    "end proxy": _terminate,
    "freeze manager": _freeze("manager"),
    "freeze proxy": _freeze("proxy"),
    "full disk": _broken(breaking.full),
    "read-only disk": _broken(breaking.read_only),
    "no descriptors": _broken(breaking.without_descriptors),
    "clock set": _clock_set,
    "suspend": _suspend,
    "rotate robot": _rotate("robot"),
    "rotate replica": _rotate("replica"),
    "update": _update,
    "kill replica": _kill_replicas(1),
    "kill all replicas": _kill_replicas(REPLICAS),
    "long suspend": _long_suspend,
}


@dataclass
class Time:
    """One fault's time, by the clock that only counts on: damaged, and whole again."""

    kind: str
    began: float
    whole: float = float("inf")
    again: list[float] = field(default_factory=list)  # damaged again

    def since(self, asked: float) -> float:
        """Return how long after the damage a request was asked, the last that it may have met."""
        met = [at for at in self.again if asked > at - UNDER_WAY_S]
        return asked - max(met, default=self.began)


@dataclass
class Row:
    """What became of the requests that were asked during a kind of fault."""

    times: int = 0
    took: list[float] = field(default_factory=list)
    lost: list[float] = field(default_factory=list)  # each: asked so long after the fault struck
    wrong: int = 0
    gap_s: float = 0.0
    whole_s: float = 0.0


def table(times: Sequence[Time], ends: Sequence[Sequence[float | None]]) -> dict[str, Row]:
    """Sort requests (asked, answered or None, right) by the fault that there was. Pure."""
    rows: dict[str, Row] = {"none": Row()}
    answered = sorted(float(end[1]) for end in ends if end[1] is not None)
    for time_ in times:
        row = rows.setdefault(time_.kind, Row())
        row.times += 1
        row.whole_s = max(row.whole_s, time_.whole - time_.began)
        within = [at for at in answered if time_.began - TAKEN_S <= at <= time_.whole + TAKEN_S]
        gaps = [later - at for at, later in itertools.pairwise(within)]
        row.gap_s = max(row.gap_s, *gaps) if gaps else time_.whole - time_.began
    for asked, at, right in ends:
        assert asked is not None
        found = [t for t in times if t.began - TAKEN_S * (at is None) <= asked <= t.whole]
        row = rows[found[0].kind] if found else rows["none"]
        if at is None:
            row.lost.append(found[0].since(asked) if found else 0.0)
        else:
            row.took.append(at - asked)
            row.wrong += not right
    return rows


def faults_found(rows: Mapping[str, Row], kinds: Sequence[str], trouble: str) -> list[str]:
    """Return why a soak has not passed; nothing if it has. Pure."""
    found = [trouble] if trouble else []
    found += [f"never done: {kind}" for kind in kinds if kind not in rows]
    for kind, row in rows.items():
        least_s = MAY_LOSE_S.get(kind, float("-inf"))
        if bad := [s for s in row.lost if s > least_s]:
            told = ", ".join(f"{s:.2f}" for s in bad[:10])
            found.append(f"{kind}: {len(bad)} lost, asked so many s after it struck: {told}")
        if row.wrong:
            found.append(f"{kind}: {row.wrong} wrong")
    return found


def show(rows: Mapping[str, Row], seed: int) -> None:
    asked = sum(len(row.took) + len(row.lost) for row in rows.values())
    lost = sum(len(row.lost) for row in rows.values())
    print(f"robot's side, seed {seed}: {asked} requests, {lost} lost")
    heads = ("requests", "lost", "in 0.5 s", "wrong", "late", "p99", "gap", "whole")
    print(f"{'fault':<22}{'times':>6}" + "".join(f"{head:>10}" for head in heads))
    for kind, row in rows.items():
        soon = sum(s <= SOON_S for s in row.lost)
        counts = (len(row.took) + len(row.lost), len(row.lost), soon, row.wrong)
        late = sum(s > LATE_S for s in row.took)
        cells = "".join(f"{n:>10}" for n in (*counts, late))
        slow_s = p99(sorted(row.took)) if row.took else float("inf")
        spans = "".join(f"{s:>8.2f} s" for s in (slow_s, row.gap_s, row.whole_s))
        print(f"{kind:<22}{row.times or '':>6}{cells}{spans}")


def run(world: World, kinds: Sequence[str], seed: int, lasts_s: float, times: list[Time]) -> None:
    """Damage the pool, every kind at least once; note when."""
    world.begin()
    end = time.monotonic() + lasts_s
    launched = [time.monotonic()] * REPLICAS
    for fault in faults(seed, kinds):
        if time.monotonic() >= end and {one.kind for one in times} >= set(kinds):
            break
        launched = [at for at in launched if at > time.monotonic() - HOUR_S]
        cost = LAUNCHES.get(fault.kind, 0)
        if cost and len(launched) + cost > MAY_LAUNCH:
            continue
        launched += [time.monotonic()] * cost
        print(f"{fault.kind}, {fault.lasts_s} s", file=sys.stderr, flush=True)
        times.append(Time(fault.kind, time.monotonic()))
        world.during = times[-1]
        with DAMAGES[fault.kind](world, fault):
            time.sleep(fault.lasts_s)
        world.wait(world.whole, f"whole after {fault.kind}")
        whole = time.monotonic()
        world.wait(lambda: world.answered(whole), f"answering after {fault.kind}")  # noqa: B023
        times[-1].whole = time.monotonic()
        time.sleep(1.0)


def kinds(*, nightly: bool) -> list[str]:
    """Return the kinds of faults that can be done in the time that there is, with one setting."""
    left_out = {"clock set"} if nightly else {"clock set", "long suspend"}
    return [kind for kind in DAMAGES if kind not in left_out]


def soak(folder: Path, seed: int, lasts_s: float, kinds: Sequence[str]) -> int:
    """Run in namespaces of one's own; return the exit status."""
    taken: dict[int, int] = {}  # the domain's lock
    world = World(folder, lock_domain(taken), sets_clock="clock set" in kinds)
    times: list[Time] = []
    trouble, twice = "", 0
    try:
        run(world, kinds, seed, lasts_s, times)
        assert world.client is not None
        twice = int(world.client.finish()["twice"])
    except (AssertionError, subprocess.TimeoutExpired) as error:
        trouble = str(error)
    finally:
        world.close()
    lines = world.ends.read_text().splitlines() if world.ends.exists() else []
    rows = table(times, [json.loads(line) for line in lines])
    show(rows, seed)
    why = faults_found(rows, kinds, trouble)
    why += [f"answered twice: {twice}"] if twice else []
    for line in why:
        print(f"FAILED: {line}")
    return 1 if why else 0
