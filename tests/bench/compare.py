"""``scripts/compare``: fogft beside what else a user may take, from idle to full and with faults.

Three replicas of a service that does one thing at a time; callers that do not wait. All systems
take turns in one run, for some rounds. `haproxy` is HAProxy with ``leastconn``, `round robin` the
same with ``roundrobin``, both before three HTTP servers that sleep as the service does and that
are started again when they die. `ray serve` is Ray Serve with three replicas, where ``--ray`` names
the Python of an environment that has it.

Prints tables, and writes them into docs/measurements.md.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests.bench import machine
from tests.bench.caller import Caller, payloads
from tests.bench.load import (
    MEDIAN_S,
    REPLICAS,
    SERVICES,
    TIMEOUT_S,
    Ask,
    Balanced,
    asking,
    haproxy,
    mean_s,
    offer,
    ray_serve,
)
from tests.bench.machine import cpu_s
from tests.bench.nodes.service import FLAG
from tests.bench.rig import ROOT, Replica, Rig
from tests.estimates import percentile

PAGE = ROOT / "docs" / "measurements.md"
HEADING = "## Beside other load balancers: `scripts/compare`"
BALANCES = {"haproxy": "leastconn", "round robin": "roundrobin"}
POISONED_S = 6.0
LEARN_S = 3.0  # of the same load before each measurement of ours: a changed policy begins to learn
LONG_FROM = 0.7  # a load from which on queues grow and shrink so slowly that it takes twice as long
# So much of a processor an idle Ray Serve takes at most; after an overload it works on for long.
CALM, CALM_LIMIT_S = 0.4, 60.0
# So slow that the machine, which all processes share, is not what limits them.
FAULT_S, FAULT_LOAD, FAULT_MEDIAN_S = 12.0, 0.7, 0.06
Rows = list[list[str]]
Peer = Callable[[Path, str], contextlib.AbstractContextManager[Balanced]]


@dataclass
class Result:
    """What became of a system's requests, over all rounds."""

    asked: int = 0
    took: list[float] = field(default_factory=list)
    copies: float = 0.0
    used_s: float = 0.0

    def cells(self) -> list[str]:
        """Return percentiles, failures, copies and processor time."""
        p50, p99 = (percentile(self.took, p) * 1000 for p in (50, 99))
        lost = self.asked - len(self.took)
        each = f"{self.copies / self.asked:.2f}", f"{self.used_s * 1000 / self.asked:.2f}"
        return [f"{p50:.0f} / {p99:.0f}", f"{lost} of {self.asked}", *each]


def ours(rig: Rig, caller: Caller, policy: str, takes_s: float) -> Callable[[float, float], Result]:
    """Return what measures fogft under a policy at a load, for so many seconds."""
    proxies = [rig.proxy.pid, *(replica.process.pid for replica in rig.replicas)]

    def measured(share: float, seconds: float) -> Result:
        rig.change(hedging=policy, timeout_s=TIMEOUT_S)
        offer(asking(caller), share, LEARN_S, takes_s)
        before = rig.report(after=time.time())["services"][FLAG[0]]["sent"]
        used = sum(map(cpu_s, proxies))
        asked, took = offer(asking(caller), share, seconds, takes_s)
        used = sum(map(cpu_s, proxies)) - used
        sent = rig.report(after=time.time())["services"][FLAG[0]]["sent"] - before
        return Result(asked, took, sent, used)

    return measured


def peers(ray: str) -> dict[str, Peer]:
    """Return what starts each other system in a folder, by its name."""
    starts: dict[str, Peer] = {
        name: lambda folder, words, balance=balance: haproxy(folder, words, balance)
        for name, balance in BALANCES.items()
    }
    if ray:
        starts["ray serve"] = lambda folder, words: ray_serve(folder, words, ray)
    return starts


def theirs(peer: Balanced, takes_s: float) -> Callable[[float, float], Result]:
    """Return the same for a load balancer. What it is behind with is no burden to the next."""

    def measured(share: float, seconds: float) -> Result:
        used = peer.used_s()
        asked, took = offer(peer.ask, share, seconds, takes_s)
        result = Result(asked, took, float(asked), peer.used_s() - used)
        limit = time.monotonic() + CALM_LIMIT_S
        while time.monotonic() < limit:
            used = peer.used_s()
            time.sleep(1.0)
            if peer.used_s() - used < CALM:
                break
        return result

    return measured


@contextlib.contextmanager
def pool(
    folder: Path, service: str, median_s: float = MEDIAN_S, relayed: Sequence[int] = ()
) -> Iterator[tuple[Rig, Caller]]:
    """Start three replicas and a caller; some are reached through a relay, which can be told."""
    folder.mkdir(parents=True)
    words = words_of(service, median_s)
    policy = {"timeout_s": TIMEOUT_S}
    rig = Rig(folder, REPLICAS, services=[words] * REPLICAS, relayed=relayed, policy=policy)
    with rig, contextlib.ExitStack() as stack:
        caller = Caller(rig.robot_domain, "compare")
        stack.callback(caller.close)
        caller.wait()
        yield rig, caller


def words_of(service: str, median_s: float = MEDIAN_S) -> str:
    """Return how a service is started: median, sigma, share of stalls, their length, threads."""
    return " ".join(map(str, (median_s, *SERVICES[service], 1)))


def loads(folder: Path, shares: Sequence[float], seconds: float, rounds: int, ray: str) -> Rows:
    """Compare systems at several loads."""
    rows = []
    for service in SERVICES:
        with contextlib.ExitStack() as stack:
            rig, caller = stack.enter_context(pool(folder / service, service))
            takes_s = mean_s(service)
            systems = {policy: ours(rig, caller, policy, takes_s) for policy in ("auto", "all")}
            for name, starts in peers(ray).items():
                below = folder / f"{service}-{name.replace(' ', '-')}"
                below.mkdir()
                peer = stack.enter_context(starts(below, words_of(service)))
                systems[name] = theirs(peer, takes_s)
            for share in shares:
                found = {name: Result() for name in systems}
                for _ in range(rounds):
                    for name, measure in systems.items():
                        if name == "all" and share > 0.3:  # it has the capacity of one
                            continue
                        lasts_s = seconds if share < LONG_FROM else 2 * seconds
                        add(found[name], measure(share, lasts_s))
                for name, result in found.items():
                    if result.asked:
                        rows.append([service, f"{share:.0%}", name, *result.cells()])
    return rows


def add(to: Result, one: Result) -> None:
    """Add what one round has brought."""
    to.asked += one.asked
    to.took += one.took
    to.copies += one.copies
    to.used_s += one.used_s


def _signal_service(replica: Replica, number: int) -> None:
    os.kill(replica.service_pid(), number)


# Name: what happens to a replica. The last one ends it.
FAULTS: Mapping[str, Callable[[Replica], None]] = {
    "service frozen": lambda replica: _signal_service(replica, signal.SIGSTOP),
    "machine frozen": lambda replica: replica.signal(signal.SIGSTOP),
    "blackholed": lambda replica: os.kill(relay_of(replica), signal.SIGUSR1),
    "killed": lambda replica: replica.signal(signal.SIGKILL),
}
MENDS: Mapping[str, Callable[[Replica], None]] = {
    "service frozen": lambda replica: _signal_service(replica, signal.SIGCONT),
    "machine frozen": lambda replica: replica.signal(signal.SIGCONT),
    "blackholed": lambda replica: os.kill(relay_of(replica), signal.SIGUSR2),
    "killed": lambda replica: None,
}


def relay_of(replica: Replica) -> int:
    """Return the process between a replica and its robot."""
    assert replica.relay is not None
    return replica.relay.pid


def faults(folder: Path, rounds: int) -> Rows:
    """Compare p99 from a fault on with that of two healthy replicas, at the same load."""
    rows = []
    healthy, at_fault = Result(), {name: Result() for name in FAULTS}
    for number in range(rounds):
        below = folder / f"faults-{number}"
        with pool(below, "constant", FAULT_MEDIAN_S, relayed=[0]) as (rig, caller):
            measure = ours(rig, caller, "auto", FAULT_MEDIAN_S)
            for name, harm in FAULTS.items():
                rig.follow([1, 2])
                rig.wait_ready([1, 2])
                add(healthy, measure(FAULT_LOAD, FAULT_S))
                rig.follow([0, 1, 2])
                rig.wait_ready([0, 1, 2])
                offer(asking(caller), FAULT_LOAD, LEARN_S, FAULT_MEDIAN_S)
                harm(rig.replicas[0])
                asked, took = offer(asking(caller), FAULT_LOAD, FAULT_S, FAULT_MEDIAN_S)
                add(at_fault[name], Result(asked, took))
                MENDS[name](rig.replicas[0])
                if name != "killed":
                    rig.wait_ready([0, 1, 2])
    base = percentile(healthy.took, 99)
    for name, result in {"two healthy replicas": healthy, **at_fault}.items():
        p99 = percentile(result.took, 99)
        rows.append([name, *result.cells()[:2], f"{p99 / base:.2f}"])
    return rows


def poison(folder: Path, rounds: int, ray: str) -> Rows:
    """Ask at 30 %, with one request among them that ends whatever process serves it."""
    rows, others = [], peers(ray)
    for name in ("auto", *others):
        result, deaths = Result(), 0
        for number in range(rounds):
            below = folder / f"poison-{name.replace(' ', '-')}-{number}"
            with contextlib.ExitStack() as stack:
                if name == "auto":
                    asks, kills, died = _poisoned_pool(
                        *stack.enter_context(pool(below, "constant"))
                    )
                else:
                    below.mkdir(parents=True)
                    peer = stack.enter_context(others[name](below, words_of("constant")))
                    asks, kills, died = peer.ask, peer.poison, peer.deaths
                offer(asks, 0.3, 3.0)
                kills()
                add(result, Result(*offer(asks, 0.3, POISONED_S)))
                deaths += died()
        rows.append([name, *result.cells()[:2], f"{deaths / rounds:.1f}"])
    return rows


def _poisoned_pool(rig: Rig, caller: Caller) -> tuple[Ask, Callable[[], None], Callable[[], int]]:
    bad = payloads(poison=True)[FLAG[0]]

    def died() -> int:
        rig.report(after=time.time())
        return sum(link["restarts"] for link in rig.links().values())

    return asking(caller), lambda: caller.ask(FLAG[0], bad, lambda: None), died


def table(head: Sequence[str], rows: Rows) -> str:
    """Return rows as a table of Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def text(measured: Mapping[str, Rows], rounds: int, seconds: float) -> str:
    """Return the section of the page."""
    cost = ["p50 / p99 ms", "failed", "copies", "ms of processor"]
    when = f"{time.strftime('%F')}, two cores, load {machine.describe()['load_before']:.1f} before"
    return f"""{HEADING}

{when}. Three replicas of a service that does one thing at a time, for 20 ms
(`constant`) or for lognormal times of which one in a hundred is 200 ms longer (`stalling`). Callers
do not wait; a request has failed after 2 s. Load is a share of what three can do. `haproxy` is
HAProxy with `leastconn`, `round robin` the same with `roundrobin`, before HTTP servers that sleep
alike; `ray serve` is Ray Serve with three replicas. Systems in turns, {rounds} rounds of
{seconds:.0f} s, from {LONG_FROM:.0%} on twice as long, of fogft after {LEARN_S:.0f} s of the same
load, as a changed policy learns. Processor time is that of the proxies, or of the balancer, a
request; of Ray Serve all its processes count.

{table(["service", "load", "system", *cost], measured["loads"])}

From a fault of one of three replicas on, for {FAULT_S:.0f} s, under `auto` at {FAULT_LOAD:.0%} of
what three can do, which is more than two can do: beside two healthy replicas at that load. The
service takes {FAULT_MEDIAN_S * 1000:.0f} ms here, so that the machine does not limit it.

{table(["fault", "p50 / p99 ms", "failed", "p99 ratio"], measured["faults"])}

One request that ends whatever process serves it, at 30 %; the others in the {POISONED_S:.0f} s
after it. HTTP servers are started again when they die, as replicas' services are.

{table(["system", "p50 / p99 ms", "failed", "deaths"], measured["poison"])}

"""


def main() -> int:
    """Measure, print, and write the page; return the exit status."""
    parser = argparse.ArgumentParser(prog="scripts/compare", description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one round, and the page as it was")
    parser.add_argument("--rounds", type=int, default=3, help="how often each system has its turn")
    parser.add_argument(
        "--ray", default="", metavar="PYTHON", help="of an environment with ray[serve]"
    )
    options = parser.parse_args()
    if not shutil.which("haproxy"):
        print("scripts/compare: install haproxy (apt-get install haproxy)", file=sys.stderr)
        return 2
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"  # before anything of ROS
    from fogft.ros import environment, memory_tuning

    environment.prepare(os.environ)
    memory_tuning.tune()
    rounds, seconds = (1, 4.0) if options.quick else (options.rounds, 10.0)
    shares = (0.1, 0.7) if options.quick else (0.1, 0.3, 0.5, 0.7, 0.9)
    with tempfile.TemporaryDirectory(prefix="fogft-compare-") as name:
        folder = Path(name)
        measured = {}
        for part, measure in (
            ("faults", lambda: faults(folder, rounds)),
            ("poison", lambda: poison(folder, rounds, options.ray)),
            ("loads", lambda: loads(folder, shares, seconds, rounds, options.ray)),
        ):
            measured[part] = measure()
            print(table([part], measured[part]), file=sys.stderr, flush=True)
    section = text(measured, rounds, seconds)
    print(section)
    if not options.quick:
        page = PAGE.read_text()
        old = re.compile(re.escape(HEADING) + r".*?(?=^## |\Z)", re.DOTALL | re.MULTILINE)
        kept = old.sub("", page)
        before, mark, after = kept.partition("## Memory")
        PAGE.write_text(f"{before}{section}{mark}{after}" if mark else f"{kept}\n{section}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
