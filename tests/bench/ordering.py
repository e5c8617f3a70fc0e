"""What the order of a stateful service costs a call, beside the same service without it."""

from __future__ import annotations

import gc
import random
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.bench.caller import Caller, milliseconds, payloads
from tests.bench.floor import Floor
from tests.bench.nodes.service import FLAG, MAP
from tests.bench.rig import Rig
from tests.estimates import estimate_of_rounds, median, overhead_ratio, percentile

_WARM_UP = 30
_REPLICAS = 2


def ordering(folder: Path, *, quick: bool) -> list[dict[str, Any]]:
    """Call two pools in turns: one whose services are plain, one whose services keep state."""
    sizes = {FLAG[0]: (300 if quick else 1500, "flag"), MAP[0]: (80 if quick else 300, "map")}
    for name in ("plain", "ordered"):
        (folder / name).mkdir()
    sides_in_turn = (("direct", "plain", "ordered"), ("ordered", "plain", "direct"))
    rows = []
    with (
        Rig(folder / "plain", _REPLICAS) as plain,
        Rig(folder / "ordered", _REPLICAS, stateful=True) as ordered,
    ):
        callers = {
            "direct": Caller(plain.domains[0], "bench_direct"),
            "plain": Caller(plain.robot_domain, "bench_plain"),
            "ordered": Caller(ordered.robot_domain, "bench_ordered"),
        }
        floor = Floor(plain.floor_folder, plain.floor_port)
        for caller in callers.values():
            caller.wait()
        for (service, (rounds, key)), payload in zip(
            sizes.items(), payloads().values(), strict=True
        ):
            sides: dict[str, list[float]] = {side: [] for side in (*callers, "get")}
            gc.collect()
            for number in range(_WARM_UP + rounds):
                turn = sides_in_turn[number % 2]  # so that none always follows the same one
                took = {side: callers[side].call(service, payload) for side in turn}
                took["get"] = floor.call(key, payload)
                if number >= _WARM_UP:
                    for side, seconds in took.items():
                        sides[side].append(seconds)
            rows.append(_row(service, len(payload), sides))
        for caller in callers.values():
            caller.close()
        floor.close()
    return rows


def _row(service: str, size_bytes: int, sides: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    in_ms = {side: milliseconds(sample) for side, sample in sides.items()}
    row: dict[str, Any] = {
        "service": service,
        "replicas": _REPLICAS,
        "request_bytes": size_bytes,
        "rounds": len(in_ms["direct"]),
    }
    for side, sample in in_ms.items():
        row[f"{side}_ms"] = median(sample)
        row[f"{side}_p99_ms"] = percentile(sample, 99)
    for name, statistic in (
        ("overhead_ratio", lambda s: _ratio(s, "plain")),
        ("ordered_ratio", lambda s: _ratio(s, "ordered")),
        ("added", lambda s: _ratio(s, "ordered") / _ratio(s, "plain") - 1),
    ):
        found = estimate_of_rounds(in_ms, statistic, random.Random(0), resamples=500)
        row[name] = {"value": found.value, "low": found.low, "high": found.high}
    return row


def _ratio(sides: Mapping[str, Sequence[float]], side: str) -> float:
    return overhead_ratio(median(sides["direct"]), median(sides[side]), median(sides["get"]))
