"""A robot whose downlink is thin, beside one whose is not, at one replica: nobody waits for it.

On networks of the test's own with the kernel's token buckets (root), and over loopback through
a slow relay, which always runs.
"""

from __future__ import annotations

import contextlib
import statistics
import time
from collections.abc import Callable

import pytest

from fogft.link.port import Answer, Link
from fogft.link.zenoh.robot.dialer import ZenohDialer
from fogft.link.zenoh.robot.link import ZenohLink
from fogft.model.replica import LinkState
from tests.link.namespaces import inside
from tests.link.thin_relay import ThinRelay
from tests.link.wire_pool import (
    POOL_UID,
    SERVICE,
    Authority,
    Owner,
    ReplicaProcess,
    keys,
    peer,
    request_id,
    wait_for,
)

MEGABYTE = 1 << 20
ASKS = b"noise:%d" % MEGABYTE
MBIT = 1.0  # a response takes eight seconds there
QUEUED, ASKED = 30, 15
LONG_S = 120.0
# A single response to the thin robot takes a thousand times as long as one to the other. What
# other work on this machine makes of two medians a second apart is far less than this.
AS_LONG = 100.0


class Timed(Owner):
    """Remembers when each answer came."""

    def __init__(self) -> None:
        super().__init__()
        self.at: dict[bytes, float] = {}

    def answered(self, link: Link, answer: Answer) -> None:
        self.at[answer.request_id] = time.monotonic()
        super().answered(link, answer)


def took_s(link: ZenohLink, owner: Timed, first: int) -> float:
    """Ask one after the other; return the median time to an answer of a megabyte."""
    times = []
    for number in range(first, first + ASKED):
        began = time.monotonic()
        assert link.offer(SERVICE, request_id(number), ASKS, LONG_S)
        wait_for(lambda n=number: owner.of(n), LONG_S)
        times.append(owner.at[request_id(number)] - began)
        assert len(owner.of(number)[0].payload or b"") == MEGABYTE
    return statistics.median(times)


def compare(
    authority: Authority,
    replica: ReplicaProcess,
    thin_endpoint: str,
    *,
    at_thin: Callable[[], contextlib.AbstractContextManager[None]] = contextlib.nullcontext,
    at_healthy: Callable[[], contextlib.AbstractContextManager[None]] = contextlib.nullcontext,
) -> tuple[float, float]:
    """Return the healthy robot's median alone, and while the thin one waits for 30 MB."""
    owner, thin_owner = Timed(), Owner()
    with contextlib.ExitStack() as stack:

        def dial(name: str, endpoint: str, to: Owner) -> ZenohLink:
            dialer = ZenohDialer(
                authority.robot(name), robot=name, pool_uid=POOL_UID, suspect_after_s=30.0
            )  # what a busy machine does is not judged
            stack.callback(dialer.close)
            return dialer.dial(peer(endpoint), keys(0), to)

        with at_healthy():
            healthy = dial("healthy", replica.endpoint, owner)
        with at_thin():
            thin = dial("thin", thin_endpoint, thin_owner)
        wait_for(lambda: healthy.usable and thin.usable, LONG_S)
        took_s(healthy, owner, 1000)  # the first ones are slower
        alone = took_s(healthy, owner, 2000)
        for number in range(QUEUED):
            assert thin.offer(SERVICE, request_id(number), ASKS, 600.0)
        wait_for(lambda: replica.count("replies") >= QUEUED + 2 * ASKED, LONG_S)
        beside = took_s(healthy, owner, 3000)
        assert len(thin_owner.answers) < QUEUED  # it waited the whole time
        assert healthy.status().reopened == 0
        assert LinkState.SUSPECT not in [state for _, state in owner.states]
    return alone, beside


def test_a_robot_behind_a_thin_relay_does_not_delay_another(
    start_replica: Callable[..., ReplicaProcess], authority: Authority
) -> None:
    replica = start_replica()
    relay = ThinRelay(replica.endpoint, MBIT * 125_000)
    try:
        alone, beside = compare(authority, replica, relay.endpoint)
    finally:
        relay.close()
    assert beside < AS_LONG * alone, (alone, beside)


@pytest.mark.own_process
def test_a_robot_on_a_thin_cable_does_not_delay_another(authority: Authority, net) -> None:
    replica_at, thin_at, healthy_at = net.add("p"), net.add("t"), net.add("h")
    _, far = net.join(thin_at, "10.83.1.1", replica_at, "10.83.1.2")
    net.join(healthy_at, "10.83.2.1", replica_at, "10.83.2.2")
    net.limit(replica_at, far, MBIT)
    with inside(replica_at):
        replica = ReplicaProcess(authority.replica(), endpoint="0.0.0.0:7447")
    replica.endpoint = "10.83.2.2:7447"
    try:
        alone, beside = compare(
            authority, replica, "10.83.1.2:7447",
            at_thin=lambda: inside(thin_at), at_healthy=lambda: inside(healthy_at),
        )  # fmt: skip
    finally:
        replica.kill()
    assert beside < AS_LONG * alone, (alone, beside)
