"""Strangers without a certificate at a replica's port: robots get in, and requests go on."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fogft.link.zenoh.robot.link import ZenohLink
from tests.hostile.stranger import SAYS
from tests.link.wire_pool import SERVICE, Owner, ReplicaProcess, request_id, wait_for

COUNT, LASTS_S = 10_000, 8.0
FEW = 6  # descriptors more than a replica has in calm
JOINS_WITHIN_S = 2.0
HERE, ELSEWHERE = "127.0.0.1", "127.0.0.66"  # the robots' address, and another one


@contextmanager
def stranger(endpoint: str, kind: str, source: str = ELSEWHERE) -> Iterator[subprocess.Popen[str]]:
    """A stranger's process that begins when the body does."""
    command = [sys.executable, "-m", "tests.hostile.stranger", endpoint, source, kind]
    with subprocess.Popen(
        [*command, str(COUNT), str(LASTS_S)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.stdin.write("begin\n")
        process.stdin.flush()
        try:
            yield process
        finally:
            process.kill()


def joins(
    dial: Callable[..., ZenohLink], replica: ReplicaProcess, open_link: ZenohLink
) -> tuple[list[float], int]:
    """Have three robots join, 1.5 s apart, while a request a 10 ms is sent.

    Returns:
        How long each took, in seconds, and the most descriptors that the replica had open.
    """
    most = 0
    took_s: list[float] = []
    sent = 0
    for robot in ("first", "second", "third"):
        begins = time.monotonic() + 1.5
        late: ZenohLink | None = None
        while late is None or not late.usable:
            assert open_link.offer(SERVICE, request_id(sent), b"x", 30.0)
            sent += 1
            time.sleep(0.01)
            most = max(most, replica.descriptors())
            assert time.monotonic() < begins + 30.0, "it was kept out"
            if late is None and time.monotonic() >= begins:
                late = dial(replica.endpoint, robot=robot, owner=Owner())
        took_s.append(time.monotonic() - begins)
    return took_s, most


@pytest.mark.parametrize("kind", SAYS)
def test_a_flood_from_elsewhere_keeps_no_robot_out_and_stops_no_request(
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    owner: Owner,
    kind: str,
) -> None:
    """Of ten thousand connections few are let in: robots join within 2 s, requests go on.

    Each that was let in before the door was shut may cost whoever comes then 0.1 s more.
    """
    replica = start_replica()
    link = dial(replica.endpoint)
    wait_for(lambda: link.usable)
    before = replica.descriptors()
    with stranger(replica.endpoint, kind):
        took_s, descriptors = joins(dial, replica, link)
    wait_for(lambda: link.status().in_flight == 0)
    let_in = replica.count("handshakes_refused") + replica.count("unauthenticated")
    print(f"{kind}: joined within {[round(one, 2) for one in took_s]} s, {let_in=} {descriptors=}")
    assert let_in < COUNT / 50
    assert descriptors < before + COUNT / 50
    assert sorted(took_s)[1] < JOINS_WITHIN_S
    assert max(took_s) < JOINS_WITHIN_S + 0.1 * let_in
    assert replica.count("kept_out") > 0
    assert {answer.payload for _, answer in owner.answers} == {b"x"}
    assert link.status().reopened == 0


def test_a_notice_is_read_and_state_is_written_while_strangers_hold_all_descriptors(
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    owner: Owner,
    tmp_path: Path,
) -> None:
    """The process may open few files more: strangers are ended for those, requests go on."""
    notice, state = tmp_path / "notice", tmp_path / "state"
    replica = start_replica()
    link = dial(replica.endpoint)
    wait_for(lambda: link.usable)
    replica.ask(watch={str(notice): str(state)})
    replica.allow_descriptors(FEW)
    with stranger(replica.endpoint, "hello"):
        wait_for(lambda: replica.count("descriptors_short") > 0)
        notice.write_text("soon")
        wait_for(state.exists)
        assert link.offer(SERVICE, request_id(1), b"x", 30.0)
        wait_for(lambda: len(owner.answers) == 1)
    late = dial(replica.endpoint, robot="late", owner=Owner())
    wait_for(lambda: late.usable)
    assert link.status().reopened == 0


def test_robots_that_share_the_strangers_address_join_once_it_leaves(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """Where one robot of that address has a link, the others are kept out no longer than needed."""
    replica = start_replica()
    link = dial(replica.endpoint)
    wait_for(lambda: link.usable)
    with stranger(replica.endpoint, "junk", HERE) as flood:
        time.sleep(1.0)
        late = dial(replica.endpoint, robot="late", owner=Owner())
        time.sleep(1.0)
        flood.kill()
        began = time.monotonic()
        wait_for(lambda: late.usable)
        took_s = time.monotonic() - began
    let_in = replica.count("handshakes_refused") + replica.count("unauthenticated")
    print(f"from here: joined within {took_s:.2f} s, let_in={let_in}")
    assert took_s < JOINS_WITHIN_S + 0.1 * let_in
    assert link.status().reopened == 0
