"""One end is frozen (SIGSTOP): it costs nobody but itself."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from fogft.byte_limit import SMALL_BYTES
from fogft.link.zenoh.robot.link import ZenohLink
from fogft.link.zenoh.settings import LinkSettings
from fogft.model.refusal import Refusal
from fogft.model.replica import LinkState
from tests.link.freezing import freeze
from tests.link.wire_pool import (
    LIMIT_S,
    SERVICE,
    Authority,
    Owner,
    ReplicaProcess,
    request_id,
    wait_for,
)
from tests.link.zenoh.robot_process import RobotProcess

MEGABYTE = os.urandom(1 << 20)
# Here a send to a frozen peer blocks for longer than any test waits. So whatever shares a
# thread, a lock or a queue with such a send fails its test, and no test needs a clock.
STUCK = LinkSettings(
    lease_s=300.0, wait_before_close_s=200.0, stall_after_s=3600.0, stuck_after_s=3600.0
)


def test_a_frozen_replica_does_not_delay_a_healthy_one(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """Every healthy answer to 1 MB requests arrives, and no offer blocks, while it is frozen."""
    options = {"reply_bytes": 16, "settings": STUCK}
    healthy, frozen = start_replica(slot=0, **options), start_replica(slot=1, **options)
    links = [
        dial(replica.endpoint, slot=n, suspect_after_s=3600.0, settings=STUCK)
        for n, replica in enumerate((healthy, frozen))
    ]
    wait_for(lambda: all(link.usable for link in links))
    frozen.signal(signal.SIGSTOP)
    for number in range(40):
        assert links[1].offer(SERVICE, request_id(number), MEGABYTE, 60.0)
        assert links[0].offer(SERVICE, request_id(number), MEGABYTE, 60.0)
        wait_for(lambda n=number: owner.of(n))
    from_healthy = [a for a in owner.from_slot(0) if a.payload is not None]
    from_frozen = [a for a in owner.from_slot(1) if a.payload is not None]
    assert (len(from_healthy), len(from_frozen)) == (40, 0)
    assert links[1].status().in_flight == 40


def test_a_frozen_replica_is_suspected_and_comes_back(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """What was in flight ends as lost, so that it can be sent again; thawed, it is up again."""
    replica = start_replica(delay_s=3600.0)
    link = dial(replica.endpoint, suspect_after_s=0.5)
    wait_for(lambda: link.usable)
    assert link.offer(SERVICE, request_id(1), b"anybody there", 60.0)
    wait_for(lambda: replica.count("requests") == 1)
    replica.signal(signal.SIGSTOP)
    wait_for(lambda: not link.usable)
    wait_for(lambda: owner.of(1))
    assert owner.of(1)[0].refusal == Refusal.LOST
    wait_for(lambda: "frozen" in link.status().detail)
    assert link.status().state is LinkState.SUSPECT
    replica.signal(signal.SIGCONT)
    wait_for(lambda: link.usable)
    replica.ask(delay_s=0.0)
    assert link.offer(SERVICE, request_id(1), b"once more", 60.0)
    wait_for(lambda: len(owner.of(1)) == 2)
    assert owner.of(1)[1].payload == b"once more"


def test_a_frozen_replica_is_given_up_without_delay_for_another(
    start_replica: Callable[..., ReplicaProcess], dial: Callable[..., ZenohLink], owner: Owner
) -> None:
    """Its link is ended with megabytes in it; nobody waits for Zenoh to close that."""
    frozen, healthy = (start_replica(slot=slot, reply_bytes=16) for slot in (0, 1))
    # In one process, as a robot's links are. Zenoh would wait for 10 s.
    links = [
        dial(replica.endpoint, slot=slot, suspect_after_s=7.0)
        for slot, replica in enumerate((frozen, healthy))
    ]
    wait_for(lambda: all(link.usable for link in links))
    frozen.signal(signal.SIGSTOP)
    for number in range(20):
        links[0].offer(SERVICE, request_id(number), MEGABYTE, 60.0)
    wait_for(lambda: not links[0].usable)
    probes = healthy.count("probes")
    wait_for(lambda: healthy.count("probes") >= probes + 2)
    assert (1, LinkState.SUSPECT) not in owner.states
    assert links[1].status().reopened == 0


@pytest.fixture
def freeze_robot(authority: Authority) -> Iterator[Callable[..., None]]:
    """Start a robot that asks a replica for so many answers, and freeze it before they come."""
    started: list[RobotProcess] = []

    def start(replica: ReplicaProcess, requests: int = 60) -> None:
        started.append(
            RobotProcess(
                authority, replica, requests=requests, payload="many bytes, please", settings=STUCK
            )
        )
        wait_for(lambda: replica.count("requests") == requests)
        freeze(started[-1].process.pid)

    yield start
    for robot in started:
        robot.kill()


@pytest.mark.parametrize(("reply_bytes", "requests"), [(1 << 20, 60), (SMALL_BYTES, 500)])
def test_a_frozen_robot_does_not_delay_another_robots_replies(
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    owner: Owner,
    freeze_robot: Callable[..., None],
    reply_bytes: int,
    requests: int,
) -> None:
    """More than all buffers hold waits for a robot that takes none; the other's replies arrive.

    Also where the first of them left at once, from the service's own thread. Nor is the other's
    link suspected meanwhile: probes have a way of their own.
    """
    replica = start_replica(delay_s=1.0, reply_bytes=reply_bytes, settings=STUCK)
    freeze_robot(replica, requests)
    link = dial(replica.endpoint)
    wait_for(lambda: link.usable)
    wait_for(lambda: replica.count("replies") >= requests)
    replica.ask(delay_s=0.0)
    for number in range(100, 130):
        assert link.offer(SERVICE, request_id(number), b"me too", 60.0)
        wait_for(lambda n=number: owner.of(n))
    assert {len(a.payload or b"") for a in owner.from_slot(0)} == {reply_bytes}
    assert link.status().reopened == 0


def test_a_frozen_robot_is_given_up_without_delay_for_another(
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    owner: Owner,
    freeze_robot: Callable[..., None],
) -> None:
    """Its link is ended with megabytes in it; nobody waits for Zenoh to close that."""
    settings = LinkSettings(stuck_after_s=0.5)
    replica = start_replica(delay_s=1.0, reply_bytes=1 << 20, settings=settings)
    freeze_robot(replica)
    link = dial(replica.endpoint, suspect_after_s=7.0)  # Zenoh would wait for 10 s
    wait_for(lambda: link.usable)
    wait_for(lambda: replica.count("stuck_links"))
    probes = replica.count("probes")
    wait_for(lambda: replica.count("probes") >= probes + 2)
    assert LinkState.SUSPECT not in {state for _, state in owner.states}
    assert link.status().reopened == 0


def test_a_robot_that_slept_suspects_nobody(
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    owner: Owner,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An hour passes while the keeper waits for an answer: it is no silence of the replica."""
    replica = start_replica(settings=STUCK)
    link = dial(replica.endpoint, suspect_after_s=LIMIT_S, settings=STUCK)
    wait_for(lambda: link.usable)
    replica.signal(signal.SIGSTOP)
    wait_for(lambda: link.status().silent_for_s > 0)
    real = time.monotonic
    monkeypatch.setattr("fogft.link.zenoh.robot.link.time.monotonic", lambda: real() + 3600.0)
    wait_for(lambda: 0 < link.status().silent_for_s < LIMIT_S)
    replica.signal(signal.SIGCONT)
    wait_for(lambda: link.status().silent_for_s == 0)
    assert link.usable
    assert link.status().reopened == 0


@pytest.mark.parametrize("settles", [False, True])
def test_closing_in_the_midst_of_a_large_send_leaves_no_thread(
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    owner: Owner,
    settles: bool,
) -> None:
    """More than all buffers hold, to a frozen replica: closed at once, and once it is stuck."""
    replica = start_replica(settings=STUCK)
    before = set(threading.enumerate())
    link = dial(replica.endpoint, suspect_after_s=3600.0, settings=STUCK)
    wait_for(lambda: link.usable)
    replica.signal(signal.SIGSTOP)
    assert link.offer(SERVICE, request_id(1), bytes(30_000_000), 600.0)
    if settles:
        wait_for(lambda: link.sending)
    link.close()
    wait_for(lambda: owner.of(1))
    wait_for(lambda: set(threading.enumerate()) <= before)
