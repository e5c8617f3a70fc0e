"""What one or two of three replicas in wrong hands cost the requests that the others answer."""

from __future__ import annotations

import contextlib
import itertools
import time
from pathlib import Path
from typing import Any

from tests.bench.caller import Caller, milliseconds, payloads
from tests.bench.nodes.service import FLAG
from tests.bench.rig import Rig
from tests.estimates import percentile
from tests.fakes.waiting import paced

SLEEP_S = 0.02
LIES = ("junk 11", "crashed", "swallowed", "boasting")
_PAUSE_S = 0.01
_SETTLES_S = 1.0  # an avoided replica is tried again, and found honest
_MOST = 2


def hostile(folder: Path, *, quick: bool, lie: str) -> list[dict[str, Any]]:
    """Compare 0, 1 and 2 of 3 replicas that lie, in turns.

    They lie to every request for as long as a block lasts, and nobody takes them away: no manager
    runs. One call follows the other: what fewer replicas can do together is not what is measured.
    `wrong` counts answers that the service does not give.
    """
    rounds, count = (2, 60) if quick else (10, 100)
    orders = {slot: folder / f"orders-{slot}" for slot in range(_MOST)}
    with Rig(folder, 3, sleep_s=SLEEP_S, hostile=orders) as rig:
        caller = Caller(rig.robot_domain, "bench_hostile")
        caller.wait()
        _calls(caller, count)  # delays and loads become known
        took: dict[int, list[float]] = {bad: [] for bad in range(_MOST + 1)}
        wrong = dict.fromkeys(took, 0)
        for _ in range(rounds):
            for bad in took:
                for slot, path in orders.items():
                    path.write_text(lie if slot < bad else "honest")
                before = caller.wrong
                took[bad] += _calls(caller, count)
                wrong[bad] += caller.wrong - before
                for path in orders.values():
                    path.write_text("honest")
                time.sleep(_SETTLES_S)
        caller.close()
    return [_row(lie, bad, took, wrong[bad], rounds * count) for bad in took]


def _calls(caller: Caller, count: int) -> list[float]:
    """Return how long each call took that was answered."""
    took = []
    for _ in itertools.islice(paced(_PAUSE_S), count):
        with contextlib.suppress(TimeoutError):
            took.append(caller.call(FLAG[0], payloads()[FLAG[0]]))
    return took


def _row(
    lie: str, bad: int, took: dict[int, list[float]], wrong: int, count: int
) -> dict[str, Any]:
    row: dict[str, Any] = {"lie": lie, "hostile": f"{bad} of 3", "requests": count}
    row |= {"unanswered": count - len(took[bad]), "wrong": wrong}
    for percent in (50, 99):
        value = percentile(took[bad], percent)
        row[f"p{percent}_ms"] = milliseconds([value])[0]
        row[f"p{percent}_ratio"] = value / percentile(took[0], percent)
    return row
