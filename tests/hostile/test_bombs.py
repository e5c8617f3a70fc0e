"""Few bytes that become many: whoever sends them, the links of all others go on as before."""

from __future__ import annotations

import contextlib
import json
import statistics
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import zenoh

from fogft.link import frame
from fogft.link.compression import unpack
from fogft.link.zenoh.robot.link import ZenohLink
from fogft.model.credentials import CredentialPaths
from tests.fakes.waiting import paced, wait_for
from tests.hostile.robot import greets, session_at, target
from tests.link.wire_pool import (
    SERVICE,
    Authority,
    Owner,
    ReplicaProcess,
    keys,
    request_id,
)
from tests.nightly import by_day

# Beside the calm run's, and beside one bomb in Zenoh's thread: 63 MiB take 40 ms and more.
NO_SLOWER, ANY_CASE_S = 3.0, 0.02


@contextlib.contextmanager
def hostile_replica(files: CredentialPaths, slot: int) -> Iterator[str]:
    """A scripted replica's process; its endpoint."""
    command = [sys.executable, "-m", "tests.hostile.replica"]
    with subprocess.Popen(
        [*command, str(files.ca), str(files.certificate), str(files.key), str(slot)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    ) as process:
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())["endpoint"]
        finally:
            process.kill()


def round_trip_s(link: ZenohLink, owner: Owner, first: int, count: int = 200) -> float:
    """Return the median of so many calls, one after another; each is answered rightly."""
    took_s = []
    for number, _ in zip(range(first, first + count), paced(0.005), strict=False):
        began = time.perf_counter()
        assert link.offer(SERVICE, request_id(number), b"x%d" % number, 20.0)
        answers = wait_for(lambda n=number: owner.of(n), pause_s=0.0002)
        took_s.append(time.perf_counter() - began)
        assert [one.payload for one in answers] == [b"x%d" % number]
    return statistics.median(took_s)


def test_a_replica_that_answers_with_bombs_slows_no_other_link(
    authority: Authority,
    good: ZenohLink,
    dial: Callable[..., ZenohLink],
    owner: Owner,
) -> None:
    """Its link is closed and says why; nothing that nobody asked for was ever unpacked."""
    calm_s = round_trip_s(good, owner, 0)
    with hostile_replica(authority.replica(1), 1) as endpoint:
        bad = dial(endpoint, slot=1, owner=Owner())
        said = set[str]()
        wait_for(lambda: bad.usable)
        wait_for(lambda: said.add(bad.status().detail) or bad.status().reopened > 1)
        attacked_s = round_trip_s(good, owner, 1000)
    calm_s = max(calm_s, round_trip_s(good, owner, 2000))  # others use the machine, too
    print(f"calm {calm_s * 1e3:.2f} ms, attacked {attacked_s * 1e3:.2f} ms, {said}")
    assert "it sends more answers than it received requests" in said
    assert attacked_s < max(NO_SLOWER * calm_s, ANY_CASE_S)
    assert good.status().reopened == 0


def test_a_robot_that_asks_with_bombs_slows_no_other_robot(
    authority: Authority,
    replica: ReplicaProcess,
    good: ZenohLink,
    owner: Owner,
) -> None:
    """Its requests are unpacked in a thread of its own; others' probes and requests go on.

    The calm run is beside who unpacks the same elsewhere: a busy machine slows both.
    """
    bomb = zlib.compress(bytes(63 << 20), 9)
    thrown, enough = 0, threading.Event()

    def round_trips_s(first: int, before: Callable[[], None] = lambda: None) -> float:
        """Return the median of some calls, with a pause after each."""
        took_s = []
        for number, _ in zip(
            range(first, first + by_day(10, at_night=50)), paced(0.05), strict=False
        ):
            before()
            took_s.append(round_trip_s(good, owner, number, 1))
        return statistics.median(took_s)

    def unpack_elsewhere() -> None:
        while not enough.is_set():
            unpack(bomb)

    elsewhere = threading.Thread(target=unpack_elsewhere)
    elsewhere.start()
    try:
        calm_s = round_trips_s(0)
    finally:
        enough.set()
        elsewhere.join()
    files = authority.robot("eve")
    at = target(replica.endpoint)
    with session_at(at, files) as session:
        token = greets(session, files, at)
        origin = frame.origin("eve", token)

        def throw() -> None:
            nonlocal thrown
            thrown += 1
            header = frame.encode_request(request_id(1 << 64 | thrown), 20.0, origin, packed=True)
            # Cut short: it is unpacked to its end, and then refused.
            session.put(
                keys(0)[SERVICE], bomb[:-1], attachment=header,
                congestion_control=zenoh.CongestionControl.BLOCK,
            )  # fmt: skip

        attacked_s = round_trips_s(1000, throw)
        wait_for(lambda: replica.count("malformed") == thrown)
    print(f"calm {calm_s * 1e3:.2f} ms, attacked {attacked_s * 1e3:.2f} ms")
    assert attacked_s < max(NO_SLOWER * calm_s, ANY_CASE_S)
    assert good.status().reopened == 0
