"""A link that ends while much flows through it holds up no other.

Each ends in the midst of something large, again and again: where one of Zenoh's threads and a
sender wait for each other, both do so for `wait_before_close_s`, which here is longer than any
test waits.
"""

from __future__ import annotations

import random
import signal
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from fogft.link.zenoh.robot.link import ZenohLink
from tests.link.test_frozen import STUCK
from tests.link.wire_pool import SERVICE, Authority, Owner, ReplicaProcess, request_id, wait_for
from tests.link.zenoh.robot_process import RobotProcess
from tests.nightly import by_day

LARGE_BYTES = 30_000_000

Starts = Callable[..., ReplicaProcess]
Dials = Callable[..., ZenohLink]


def usable(dial: Dials, replica: ReplicaProcess, **options: Any) -> ZenohLink:
    link = dial(replica.endpoint, suspect_after_s=3600.0, settings=STUCK, **options)
    wait_for(lambda: link.usable)
    return link


def a_moment(number: int, most_s: float = 0.02) -> None:
    """Let a moment pass, another one for each number."""
    time.sleep(random.Random(number).random() * most_s)


def sends_large(link: ZenohLink, number: int) -> None:
    """Return when it has begun, and a moment after."""
    assert link.offer(SERVICE, request_id(number), bytes(LARGE_BYTES), 600.0)
    wait_for(lambda: link.sending or not link.status().in_flight)  # it may be quicker than a look
    a_moment(number)


def answered(owner: Owner, link: ZenohLink, number: int) -> None:
    assert link.offer(SERVICE, request_id(number), b"", 600.0)
    wait_for(lambda: any(answer.payload is not None for answer in owner.of(number)))


@pytest.mark.parametrize("frozen", [False, True])
def test_by_the_robot_while_it_sends(
    start_replica: Starts, dial: Dials, owner: Owner, frozen: bool
) -> None:
    replica = start_replica(settings=STUCK)
    before = set(threading.enumerate())
    for number in range(by_day(6, at_night=40)):
        link = usable(dial, replica)
        if frozen:
            replica.signal(signal.SIGSTOP)
        sends_large(link, number)
        link.close()
        wait_for(lambda n=number: owner.of(n))
        wait_for(lambda: set(threading.enumerate()) <= before)
        replica.signal(signal.SIGCONT)


def test_by_the_robot_while_it_is_answered(
    start_replica: Starts, dial: Dials, owner: Owner
) -> None:
    """The replica answers another robot meanwhile: here its other link."""
    replica = start_replica(settings=STUCK)
    other = usable(dial, replica)
    for number in range(by_day(6, at_night=40)):
        link = usable(dial, replica)
        asked = f"noise:{LARGE_BYTES}".encode()
        assert link.offer(SERVICE, request_id(2 * number), asked, 600.0)
        a_moment(number, 0.05)
        link.close()
        answered(owner, other, 2 * number + 1)


@pytest.mark.parametrize("killed", [False, True])
def test_by_the_replica_while_it_is_sent_to(
    start_replica: Starts, dial: Dials, owner: Owner, killed: bool
) -> None:
    """The robot's link to another replica goes on."""
    other = usable(dial, start_replica(settings=STUCK))
    for number in range(1, 1 + by_day(4, at_night=20)):
        replica = start_replica(slot=number, settings=STUCK)
        link = usable(dial, replica, slot=number)
        sends_large(link, 2 * number)
        replica.kill() if killed else replica.stop()
        wait_for(lambda link=link: not link.usable)
        answered(owner, other, 2 * number + 1)
        link.close()


def test_by_a_robot_that_is_killed_while_it_is_answered(
    authority: Authority, start_replica: Starts, dial: Dials, owner: Owner
) -> None:
    """The replica's link to another robot goes on."""
    replica = start_replica(settings=STUCK)
    link = usable(dial, replica)
    asks = {"requests": 2, "payload": f"noise:{LARGE_BYTES}", "settings": STUCK}
    for number in range(by_day(3, at_night=12)):
        before = replica.count("replies")
        robot = RobotProcess(authority, replica, **asks)
        wait_for(lambda n=before: replica.count("replies") > n)
        a_moment(number)
        robot.kill()
        answered(owner, link, number)
