"""``scripts/bench``: run the measurements, print tables, write `bench-results/TIME.json`."""

from __future__ import annotations

import argparse
import functools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from fogft.errors import FogftError
from tests.bench import machine
from tests.bench.rig import ROOT

Rows = list[dict[str, Any]]


def measurements() -> dict[str, Callable[..., Rows]]:
    """Return what can be measured, by name, in the order of running."""
    from tests.bench import (
        commands,
        faults,
        first,
        graph,
        hostile,
        images,
        load,
        ordering,
        planning,
        simulation,
        speed,
        tail,
        uplink,
    )

    found: dict[str, Callable[..., Rows]] = {
        "commands": commands.commands,
        "planning": planning.planning,
    }
    for replicas in (1, 2, 3):
        found[f"overhead-{replicas}"] = functools.partial(speed.overhead, replicas=replicas)
    found["rmw_zenoh"] = speed.overhead_over_zenoh
    found["throughput"] = speed.throughput
    found["stalls"] = faults.stalls
    found["killed"] = faults.killed
    for lie in hostile.LIES:
        found[f"hostile-{lie.replace(' ', '-')}"] = functools.partial(hostile.hostile, lie=lie)
    found["restarted"] = faults.restarted
    found["memory"] = speed.memory
    found["hours"] = speed.hours
    found["hedging"] = tail.hedging
    found["load"] = load.load
    found["idle"] = load.idle
    found["cancellation"] = tail.cancellation
    found["simulation"] = simulation.simulation
    found["ordering"] = ordering.ordering
    found["graph"] = graph.graph
    found["images"] = images.images
    found["bursts"] = graph.bursts
    found["first"] = first.first
    found["lone"] = first.lone
    found["uplink"] = uplink.uplink
    return found


def cell(value: Any) -> str:
    """Return a value as a table shows it."""
    if isinstance(value, dict):
        return f"{value['value']:.3g} [{value['low']:.3g}, {value['high']:.3g}]"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def flat(row: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield a row's entries, those of nested tables one by one; leave out long lists."""
    for key, value in row.items():
        if isinstance(value, dict) and "value" not in value:
            yield from ((f"{key}: {inner}", entry) for inner, entry in value.items())
        elif not isinstance(value, list):
            yield key, value


def shown(rows: Rows) -> list[tuple[str, ...]]:
    """Return the cells of a table with a column for each row, sizes in megabytes."""
    rows = [dict(flat(row)) for row in rows]
    lines = []
    for key in rows[0]:
        values = [row[key] for row in rows]
        if key.endswith("_bytes") and max(values) >= 1e6:
            lines.append((key.replace("_bytes", "_mb"), *(f"{v / 1e6:.1f}" for v in values)))
        else:
            lines.append((key, *map(cell, values)))
    return lines


def table(lines: Sequence[tuple[str, ...]]) -> str:
    """Return lines of cells as text, each column as wide as its widest cell."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )


def main() -> int:
    """Run what the arguments ask for; return the exit status."""
    parser = argparse.ArgumentParser(prog="scripts/bench", description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer rounds: to see that it runs")
    parser.add_argument(
        "--only", action="append", metavar="NAME", help="a name, or its beginning; repeatable"
    )
    parser.add_argument("--list", action="store_true", help="print the names, measure nothing")
    options = parser.parse_args()
    # Before anything of ROS is imported: the measuring client is a ROS process like the others.
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    from fogft.ros import environment, memory_tuning

    environment.prepare(os.environ)
    memory_tuning.tune()
    chosen = {
        name: run
        for name, run in measurements().items()
        if not options.only or any(name.startswith(o) for o in options.only)
    }
    if options.list or not chosen:
        print("\n".join(chosen or measurements()))
        return 0 if chosen else 2
    result: dict[str, Any] = {
        "machine": machine.describe(),
        "commit": _commit(),
        "began": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "quick": options.quick,
        "results": {},
    }
    print(table([(key, cell(value)) for key, value in result["machine"].items()]))
    target = ROOT / "bench-results" / f"{time.strftime('%Y%m%d-%H%M%S')}.json"
    target.parent.mkdir(exist_ok=True)
    status = 0
    for name, run in chosen.items():
        began = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="fogft-bench-") as folder:
            try:
                rows = run(Path(folder), quick=options.quick)
            except (OSError, RuntimeError, subprocess.SubprocessError, FogftError) as error:
                print(f"\n{name}: failed: {error}", file=sys.stderr)
                result["results"][name] = {"failed": str(error)}
                status = 1
                continue
        result["results"][name] = rows
        print(f"\n{name} ({time.monotonic() - began:.0f} s)\n{table(shown(rows))}", flush=True)
        target.write_text(json.dumps(result, indent=1) + "\n")
    target.write_text(json.dumps(result, indent=1) + "\n")
    print(f"\nwritten to {target.relative_to(ROOT)}")
    return status


def _commit() -> str:
    try:
        found = subprocess.run(
            ["git", "describe", "--always", "--dirty"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
        )
    except OSError:
        return ""
    return found.stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
