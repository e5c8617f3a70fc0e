"""What a frozen, a cut-off and a killed replica cost the requests that flow meanwhile."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.bench.caller import Caller, milliseconds, payloads
from tests.bench.nodes.service import FLAG, MAP
from tests.bench.rig import Replica, Rig
from tests.estimates import estimate, estimate_of_rounds, longest_gap, median, percentile
from tests.fakes.waiting import paced

SLEEP_S = 0.02
_PAUSE_S = 0.01
_VICTIM = 2


def _freeze(replica: Replica, on: bool) -> None:
    replica.signal(signal.SIGSTOP if on else signal.SIGCONT)


def _blackhole(replica: Replica, on: bool) -> None:
    assert replica.relay is not None
    os.kill(replica.relay.pid, signal.SIGUSR1 if on else signal.SIGUSR2)


def stalls(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Compare 0.9 MB calls with one of three replicas frozen or cut off, and two alone.

    Each block with a fault begins at the fault, so the time until the replica is suspected
    and the attempts to reopen its link are in it.
    """
    blocks, seconds = (1, 4.0) if quick else (3, 10.0)
    rows = []
    with Rig(folder, 3, sleep_s=SLEEP_S, relayed=[_VICTIM]) as rig:
        caller = Caller(rig.robot_domain, "bench_stalls")
        caller.wait()
        payload = payloads()[MAP[0]]
        faults: dict[str, Callable[[Replica, bool], None]] = {
            "frozen": _freeze,
            "blackholed": _blackhole,
        }
        for name, fault in faults.items():
            alone: list[float] = []
            three: list[float] = []
            for _ in range(blocks):
                rig.follow([0, 1])
                rig.wait_ready([0, 1])
                alone += _block(caller, payload, seconds)
                rig.follow([0, 1, 2])
                rig.wait_ready([0, 1, 2])
                fault(rig.replicas[_VICTIM], True)
                three += _block(caller, payload, seconds)
                fault(rig.replicas[_VICTIM], False)
            rows.append(_row(name, milliseconds(alone), milliseconds(three)))
        caller.close()
    return rows


def _block(caller: Caller, payload: bytes, seconds: float) -> list[float]:
    took = []
    for _ in paced(_PAUSE_S, seconds=seconds):
        took.append(caller.call(MAP[0], payload))
    return took


def _row(name: str, alone: list[float], three: list[float]) -> dict[str, Any]:
    rounds = min(len(alone), len(three))
    ratio = estimate_of_rounds(
        {"alone": alone[:rounds], "three": three[:rounds]},
        lambda s: percentile(s["three"], 99) / percentile(s["alone"], 99),
        random.Random(0),
        resamples=500,
    )
    row: dict[str, Any] = {"fault": name, "service_sleep_ms": SLEEP_S * 1000}
    for side, sample in (("two_alone", alone), ("one_of_three", three)):
        row[f"{side}_requests"] = len(sample)
        for percent in (50, 99, 100):
            row[f"{side}_p{percent}_ms"] = percentile(sample, percent)
    row["p99_ratio"] = {"value": ratio.value, "low": ratio.low, "high": ratio.high}
    return row


def killed(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Kill two of three replicas, one after the other, while calls follow each other."""
    rows = []
    for repeat in range(1 if quick else 3):
        with Rig(_sub(folder, repeat), 3, sleep_s=SLEEP_S) as rig:
            caller = Caller(rig.robot_domain, "bench_killed")
            caller.wait()
            payload = payloads()[FLAG[0]]
            for victim in (0, 1):
                _calls(caller, payload, 0.5)
                before, _ = _calls(caller, payload, 2.0)
                rig.replicas[victim].signal(signal.SIGKILL)
                after, failed = _calls(caller, payload, 3.0)
                gap_s = longest_gap([before[-1], *after])
                rows.append(
                    {
                        "fault": f"killed, {2 - victim} left",
                        "requests": len(after) + failed,
                        "failed": failed,
                        "service_sleep_ms": SLEEP_S * 1000,
                        "longest_gap_ms": gap_s * 1000,
                        "gap_beyond_service_ms": (gap_s - SLEEP_S) * 1000,
                        "usual_longest_gap_ms": longest_gap(before) * 1000,
                    }
                )
            caller.close()
    return rows


def restarted(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Kill the client proxy; how long until the next answer, with another one in line, or none.

    A request every 10 ms; the pauses before a kill are chance, for DDS has periods of seconds.
    """
    rows, chance = [], random.Random(0)
    with Rig(folder, 1) as rig:
        caller = Caller(rig.robot_domain, "bench_restarted")
        caller.wait()
        payload = payloads()[FLAG[0]]
        for in_line in (True, False):
            gaps, lost = [], []
            for _ in range(2 if quick else 12):
                if in_line:
                    rig.put_in_line()
                _ask_until(caller, payload, time.monotonic() + chance.uniform(1.0, 4.0))
                killed_at = rig.kill_proxy()
                answered, asked = _ask_until(caller, payload, None)
                gaps.append(answered[0] - killed_at)
                lost.append(asked - len(answered))
                rig.wait_ready([0])
            took = estimate(gaps, median)
            rows.append(
                {
                    "in_line": str(in_line),
                    "kills": len(gaps),
                    "gap_s": {"value": took.value, "low": took.low, "high": took.high},
                    "longest_gap_s": max(gaps),
                    "requests_lost_median": median(lost),
                }
            )
        caller.close()
    return rows


def _ask_until(caller: Caller, payload: bytes, end: float | None) -> tuple[list[float], int]:
    """Ask every 10 ms until a moment, or the first answer; return their times, and asked."""
    answered: list[float] = []
    asked = 0
    while time.monotonic() < end if end is not None else not answered:
        caller.ask(FLAG[0], payload, lambda: answered.append(time.monotonic()))
        asked += 1
        time.sleep(_PAUSE_S)
    time.sleep(0.5)
    return answered, asked


def _calls(caller: Caller, payload: bytes, seconds: float) -> tuple[list[float], int]:
    """Call without a pause; return when each answer came, and how many never did."""
    moments, failed = [], 0
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            caller.call(FLAG[0], payload)
        except TimeoutError:
            failed += 1
        else:
            moments.append(time.monotonic())
    return moments, failed


def _sub(folder: Path, number: int) -> Path:
    made = folder / str(number)
    made.mkdir()
    return made
