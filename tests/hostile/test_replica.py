"""One of three replicas is in wrong hands: no request that the others answer is wrong or lost.

A real client proxy and real replicas; the hostile one has a good certificate. Without a manager,
nobody takes it away: each request of the whole test may meet it.
"""

from __future__ import annotations

import contextlib
import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from fogft.model.choices import Speaks
from tests.bench.caller import Caller, payloads
from tests.bench.nodes.service import FLAG
from tests.bench.rig import Rig
from tests.estimates import percentile
from tests.nightly import NIGHTLY, by_day
from tests.rmw_zenoh import rmw_router

pytestmark = [pytest.mark.ros, pytest.mark.timeout(1800 if NIGHTLY else 180)]

COUNT, PER_S = by_day(50, at_night=2000), 40.0
SLEEP_S = 0.01
JUNK = ("junk 0", "junk 4", "junk 11", "junk 65536")
LIES = (*JUNK, "crashed", "refused", "swallowed", "boasting", "claims", "escapes")


@contextlib.contextmanager
def scene(folder: Path, speaks: Speaks) -> Iterator[tuple[Caller, Path]]:
    """Start three replicas, one of which does what a file says; yield a caller and that file."""
    orders = folder / "orders"
    with contextlib.ExitStack() as held:
        environ = {}
        if speaks is Speaks.ZENOH:
            environ = held.enter_context(rmw_router.running()).environ
        rig = held.enter_context(
            Rig(folder, 3, sleep_s=SLEEP_S, hostile={0: orders}, rmw=speaks.value, environ=environ)
        )
        caller = Caller(rig.robot_domain, "hostile", speaks=speaks, environ=environ)
        held.callback(caller.close)
        caller.wait()
        caller.call(FLAG[0], payloads()[FLAG[0]])  # the first answer takes as long as discovery
        yield caller, orders


@pytest.mark.parametrize("speaks", [Speaks.RCLPY, Speaks.ZENOH])
def test_what_one_replica_does_costs_no_answer(tmp_path: Path, speaks: Speaks) -> None:
    """What is no response differs with what the robot speaks; at night, so does all else."""
    with scene(tmp_path, speaks) as (caller, orders):
        calm = caller.spread(FLAG[0], payloads()[FLAG[0]], COUNT, PER_S, random.Random(0))
        for lie in LIES if speaks is Speaks.RCLPY or NIGHTLY else JUNK:
            orders.write_text(lie)
            took = caller.spread(FLAG[0], payloads()[FLAG[0]], COUNT, PER_S, random.Random(lie))
            orders.write_text("honest")
            print(
                f"{lie}: p50 {percentile(calm, 50) * 1e3:.1f} -> {percentile(took, 50) * 1e3:.1f}"
                f" ms, p99 {percentile(calm, 99) * 1e3:.1f} -> {percentile(took, 99) * 1e3:.1f} ms,"
                f" lost {COUNT - len(took)}, wrong {caller.wrong}"
            )
            assert (len(took), caller.wrong) == (COUNT, 0), lie
