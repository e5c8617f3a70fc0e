"""Overhead and throughput: what the proxies cost a call, and how many they carry."""

from __future__ import annotations

import gc
import os
import random
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from fogft.model.choices import Speaks
from tests.bench import machine
from tests.bench.caller import Caller, Flood, map_request, milliseconds, payloads
from tests.bench.floor import Floor
from tests.bench.nodes.service import FLAG, MAP
from tests.bench.rig import Rig
from tests.estimates import Estimate, estimate_of_rounds, median, overhead_ratio, percentile
from tests.rmw_zenoh import rmw_router

_WARM_UP = 30
_IN_FLIGHT = 64


def overhead_over_zenoh(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Do the same with `rmw: zenoh` at both ends, two replicas and a router."""
    with rmw_router.running() as router:
        return overhead(folder, 2, quick=quick, speaks=Speaks.ZENOH, environ=router.environ)


def overhead(
    folder: Path,
    replicas: int,
    *,
    quick: bool,
    speaks: Speaks = Speaks.RCLPY,
    environ: Mapping[str, str] = MappingProxyType({}),
) -> list[dict[str, Any]]:
    """Compare direct calls, proxied calls and bare round trips, in turns, in one run.

    Processor time is that of proxied calls and of the barest way's (`bare`), in turns as well.
    """
    sizes = {FLAG[0]: (300 if quick else 1500, "flag"), MAP[0]: (80 if quick else 300, "map")}
    rows = []
    has_bare = speaks is Speaks.RCLPY
    with Rig(folder, replicas, rmw=speaks.value, environ=environ, bare=has_bare) as rig:
        of_caller = {"speaks": speaks, "environ": environ}
        direct = Caller(rig.domains[0], "bench_direct", **of_caller)
        proxied = Caller(rig.robot_domain, "bench_proxied", **of_caller)
        bare = Caller(rig.bare_domain, "bench_bare", **of_caller) if has_bare else None
        floor = Floor(rig.floor_folder, rig.floor_port)
        direct.wait()
        proxied.wait()
        if bare is not None:
            bare.wait()
        for (service, (rounds, key)), payload in zip(
            sizes.items(), payloads().values(), strict=True
        ):
            sides: dict[str, list[float]] = {"direct": [], "proxied": [], "get": []}
            if bare is not None:
                sides["bare"] = []
            gc.collect()
            for number in range(_WARM_UP + rounds):
                took = {
                    "direct": direct.call(service, payload),
                    "proxied": proxied.call(service, payload),
                    "get": floor.call(key, payload),
                }
                if bare is not None:
                    took["bare"] = bare.call(service, payload)
                if number >= _WARM_UP:
                    for side, seconds in took.items():
                        sides[side].append(seconds)
            row = _row(service, replicas, len(payload), sides)
            before = _cpu_used(rig)
            for _ in range(rounds):
                for caller in filter(None, (proxied, bare)):
                    caller.call(service, payload)
            row["cpu_ms_per_request"] = _cpu_per_request(before, rig, rounds)
            rows.append(row)
        for caller in filter(None, (direct, proxied, bare)):
            caller.close()
        floor.close()
    return rows


def _row(
    service: str, replicas: int, size_bytes: int, sides: dict[str, list[float]]
) -> dict[str, Any]:
    source = random.Random(0)
    in_ms = {side: milliseconds(sample) for side, sample in sides.items()}
    row: dict[str, Any] = {
        "service": service,
        "replicas": replicas,
        "request_bytes": size_bytes,
        "rounds": len(sides["direct"]),
    }
    for side, sample in in_ms.items():
        row[f"{side}_ms"] = _interval(
            estimate_of_rounds(
                {side: sample}, lambda s, side=side: median(s[side]), source, resamples=500
            )
        )
        row[f"{side}_p99_ms"] = percentile(sample, 99)
    for way, name in (("proxied", "overhead_ratio"), ("bare", "bare_ratio")):
        if way in in_ms:
            row[name] = _interval(
                estimate_of_rounds(
                    in_ms,
                    lambda s, way=way: overhead_ratio(
                        median(s["direct"]), median(s[way]), median(s["get"])
                    ),
                    source,
                    resamples=500,
                )
            )
    return row


def _interval(found: Estimate) -> dict[str, float]:
    return {"value": found.value, "low": found.low, "high": found.high}


def _cpu_used(rig: Rig) -> dict[str, float]:
    """Return the processor time used so far by role, all replicas together, in seconds."""
    roles = {
        "caller": [os.getpid()],
        "client_proxy": [rig.proxy.pid],
        "server_proxies": [r.process.pid for r in rig.replicas],
        "services": [r.service_pid() for r in rig.replicas],
        "bare": [process.pid for process in rig.bare[::2]],  # its ends, as the proxies are
    }
    return {role: sum(map(machine.cpu_s, pids)) for role, pids in roles.items()}


def _cpu_per_request(before: dict[str, float], rig: Rig, requests: int) -> dict[str, float]:
    """Return what each role has used since, in milliseconds a request."""
    return {role: (s - before[role]) * 1000 / requests for role, s in _cpu_used(rig).items()}


def throughput(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Count SetBool calls per second with 64 in flight: direct, and through two replicas.

    Through the proxies, and the barest way (`bare`); these take turns.
    """
    count = 3_000 if quick else 20_000
    with Rig(folder, 2, bare=True) as rig:
        payload = payloads()[FLAG[0]]
        ways = {
            "direct": rig.domains[0],
            "bare": rig.bare_domain,
            "proxied": rig.robot_domain,
        }
        floods: dict[str, list[Flood]] = {way: [] for way in ways}
        used: dict[str, Counter[str]] = {way: Counter() for way in ways}
        for _ in range(3):
            for way, domain in ways.items():
                # One at a time: DDS sends every response to all clients of a service.
                caller = Caller(domain, f"bench_{way}")
                caller.wait()
                caller.flood(FLAG[0], payload, 500, _IN_FLIGHT)
                before = _cpu_used(rig)
                floods[way].append(caller.flood(FLAG[0], payload, count, _IN_FLIGHT))
                used[way].update(_cpu_per_request(before, rig, 3 * count))
                caller.close()
    return [_throughput_row(way, floods[way], count, dict(used[way])) for way in ways]


def _throughput_row(
    way: str, floods: Sequence[Flood], count: int, cpu_ms: dict[str, float]
) -> dict[str, Any]:
    per_s = [flood.answered / flood.seconds for flood in floods]
    requests = count * len(floods)
    return {
        "way": way,
        "replicas": 2,
        "in_flight": _IN_FLIGHT,
        "requests": requests,
        "unanswered": requests - sum(flood.answered for flood in floods),
        "per_s": median(per_s),
        "per_s_low": min(per_s),
        "per_s_high": max(per_s),
        "cpu_ms_per_request": cpu_ms,
    }


def _proxies(rig: Rig) -> dict[str, int]:
    """Return the process id of each proxy, by what it is."""
    servers = {f"server proxy {one.id.slot}": one.process.pid for one in rig.replicas}
    return {"client proxy": rig.proxy.pid, **servers}


def hours(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Follow each proxy's own memory over two hours of requests of all sizes, to 4 MB.

    Medians of ten looks in each twelfth of the time (with `quick`, sixth).
    """
    lasts_s, windows = (60.0, 6) if quick else (7200.0, 12)
    source = random.Random(0)
    with Rig(folder, 2) as rig:
        proxies, small = _proxies(rig), payloads()[FLAG[0]]
        caller = Caller(rig.robot_domain, "bench_hours")
        caller.wait()
        seen: dict[str, list[list[int]]] = {name: [[] for _ in range(windows)] for name in proxies}
        asked = unanswered = 0
        begin, look_at = time.monotonic(), 0.0
        while (spent_s := time.monotonic() - begin) < lasts_s:
            large = map_request(int(10 ** source.uniform(2.0, 6.6)))
            for _ in range(source.choice((1, 1, 1, 8))):
                asked += 2
                unanswered += 1 - caller.flood(MAP[0], large, 1, 1).answered
                unanswered += 1 - caller.flood(FLAG[0], small, 1, 1).answered
            if spent_s >= look_at:
                look_at = spent_s + lasts_s / windows / 10
                for name, pid in proxies.items():
                    window = int(spent_s / lasts_s * windows)
                    seen[name][window].append(machine.own_memory_bytes(pid))
            time.sleep(0.2)
        caller.close()
    medians_of = {
        name: [int(median([float(size) for size in window])) for window in found]
        for name, found in seen.items()
    }
    return [
        {
            "process": name,
            "requests": asked,
            "unanswered": unanswered,
            "minutes": lasts_s / 60,
            "first_bytes": medians[0],
            "second_bytes": medians[1],
            "half_time_bytes": medians[windows // 2],
            "last_bytes": medians[-1],
            "most_bytes": max(map(max, seen[name])),
            "all_bytes": medians,
        }
        for name, medians in medians_of.items()
    ]


def memory(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Follow each proxy's own memory over many requests (and some large ones before)."""
    steps, step = 10, 1_000 if quick else 10_000
    with Rig(folder, 2) as rig:
        proxies = _proxies(rig)
        caller = Caller(rig.robot_domain, "bench_memory")
        caller.wait()
        small, large = payloads()[FLAG[0]], payloads()[MAP[0]]
        grown: dict[str, list[int]] = {name: [] for name in proxies}

        def look() -> None:
            for name, pid in proxies.items():
                grown[name].append(machine.own_memory_bytes(pid))

        look()
        caller.flood(MAP[0], large, 200, 8)
        look()
        unanswered = 0
        for _ in range(steps):
            unanswered += step - caller.flood(FLAG[0], small, step, _IN_FLIGHT).answered
            look()
        caller.close()
    return [
        {
            "process": name,
            "requests": steps * step,
            "unanswered": unanswered,
            "at_start_bytes": sizes[0],
            "after_200_large_bytes": sizes[1],
            "after_first_step_bytes": sizes[2],
            "at_end_bytes": sizes[-1],
            "all_bytes": sizes,
        }
        for name, sizes in grown.items()
    ]
