"""What hedging makes of the tail, and what cancellation saves."""

from __future__ import annotations

import random
import time
from pathlib import Path
from typing import Any

from tests.bench.caller import Caller, milliseconds, payloads
from tests.bench.nodes.service import CANCEL, FLAG
from tests.bench.rig import Rig
from tests.estimates import percentile

# Service times of facts that robots meet: lognormal, and one request in a hundred stalls.
_MEDIAN_S, _SIGMA, _STALLED, _STALL_S = 0.1, 0.35, 0.01, 2.0
_PER_S = 15.0


def hedging(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Compare the policies on two replicas that stall, with a third one that does not, alone.

    The policy is changed while the client proxy runs. Copies count all that was sent, probing
    copies too. The ratio is p99 over the median of the replica that never stalls, asked
    directly, in the same run.
    """
    count = 300 if quick else 2000
    stalling = f"{_MEDIAN_S} {_SIGMA} {_STALLED} {_STALL_S}"
    steady = f"{_MEDIAN_S} {_SIGMA}"
    rows = []
    with Rig(folder, 3, services=[stalling, stalling, steady]) as rig:
        rig.follow([0, 1])
        rig.wait_ready([0, 1])
        proxied = Caller(rig.robot_domain, "bench_hedging")
        direct = Caller(rig.domains[2], "bench_steady")
        proxied.wait()
        direct.wait()
        payload = payloads()[FLAG[0]]
        for number, policy in enumerate(("failover", "auto", "all")):
            rig.change(hedging=policy)
            before = rig.report()["services"][FLAG[0]]
            source = random.Random(number)
            took = proxied.spread(FLAG[0], payload, count, _PER_S, source)
            alone = direct.spread(FLAG[0], payload, count // 4, _PER_S, source)
            after = rig.report(after=time.time())["services"][FLAG[0]]
            median_s = percentile(alone, 50)
            rows.append(
                {
                    "policy": policy,
                    "requests": count,
                    "unanswered": count - len(took),
                    **{f"p{p:g}_ms": percentile(milliseconds(took), p) for p in (50, 99, 99.9)},
                    "steady_p50_ms": median_s * 1000,
                    "p99_ratio": percentile(took, 99) / median_s,
                    "copies": (after["sent"] - before["sent"])
                    / (after["received"] - before["received"]),
                }
            )
        proxied.close()
        direct.close()
    return rows


_SLOW_S, _FAST_S = 0.15, 0.04
_LOAD = 1.5


def cancellation(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Count what a replica at 150 % load works for nothing: it gets each request, and is slower.

    Until it is idle again. Both work on one request after the other. Three ways: losers are
    not told; they are told and drop what waits; they interrupt what is at work, too.
    """
    count = 60 if quick else 300
    services = [f"{_FAST_S} 0.2 0 0 1", f"{_SLOW_S} 0.2 0 0 1"]
    rows = []
    ways: dict[str, tuple[bool, dict[str, Any]]] = {
        "not told": (False, {"concurrency": 1}),
        "dropped": (True, {"concurrency": 1}),
        "interrupted": (True, {"cancel": CANCEL[0]}),
    }
    for name, (told, replica) in ways.items():
        below = folder / name.replace(" ", "-")
        below.mkdir()
        with Rig(below, 2, services=services, replica=replica, tell_losers=told) as rig:
            rig.change(hedging="all")
            caller = Caller(rig.robot_domain, "bench_cancel")
            caller.wait()
            took = caller.spread(
                FLAG[0], payloads()[FLAG[0]], count, _LOAD / _SLOW_S, random.Random(1)
            )
            slow = _when_idle(rig)
            caller.close()
        work = slow["work"]
        rows.append(
            {
                "losers": name,
                "requests": count,
                "unanswered": count - len(took),
                "p99_ms": percentile(milliseconds(took), 99),
                "won": slow["won"],
                **{key: work[key] for key in ("ran", "saved", "interrupted", "ran_s")},
                # By what it won, for a replica that is not told does not know.
                "wasted_s": work["ran_s"] * (1 - slow["won"] / work["ran"]),
            }
        )
    for row in rows:
        row["wasted_less"] = 1 - row["wasted_s"] / rows[0]["wasted_s"]
    return rows


def _when_idle(rig: Rig) -> dict[str, Any]:
    """Return what is reported of the slow replica once it has nothing to do any more."""
    limit = time.monotonic() + 60.0
    idle = 0
    while idle < 3:  # it tells with each probe, once a second
        link = {link["slot"]: link for link in rig.report(after=time.time())["links"]}[1]
        idle = idle + 1 if link["work"].get("held") == 0 else 0
        if time.monotonic() > limit:
            raise RuntimeError("the slow replica does not become idle")
        time.sleep(1.1)
    return link
