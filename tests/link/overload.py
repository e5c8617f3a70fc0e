"""``python -m tests.link.overload``: ask a thin uplink for more than it carries, and count answers.

Twice: everything is sent in its order, and what cannot arrive before its deadline is declined.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from unittest import mock

from fogft.link.port import SendOptions
from fogft.link.socket_progress import DeadlineFilter
from fogft.link.zenoh.robot.dialer import ZenohDialer
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

BYTES_PER_S = 125_000
SIZE, TIMEOUT_S, EVERY_S, REQUESTS = 300_000, 6.0, 1.0, 60


def answered_in_time() -> int:
    """Ask; return how many were answered."""
    owner, payload = Owner(), os.urandom(SIZE)
    with tempfile.TemporaryDirectory() as folder:
        authority = Authority(Path(folder))
        replica = ReplicaProcess(authority.replica(), reply_bytes=16)
        relay = ThinRelay(replica.endpoint, BYTES_PER_S)
        dialer = ZenohDialer(authority.robot(), robot="robot", pool_uid=POOL_UID)
        try:
            dialer.adopt(SendOptions(timed=frozenset({SERVICE})))
            link = dialer.dial(peer(relay.endpoint), keys(0), owner)
            wait_for(lambda: link.usable)
            deadlines: list[tuple[float, int]] = []
            end = time.monotonic() + REQUESTS * EVERY_S + TIMEOUT_S
            for number in range(REQUESTS):
                if link.offer(SERVICE, request_id(number), payload, TIMEOUT_S):
                    deadlines.append((time.monotonic() + TIMEOUT_S, number))
                while deadlines and deadlines[0][0] <= time.monotonic():
                    link.forget(request_id(deadlines.pop(0)[1]))
                time.sleep(EVERY_S)
            time.sleep(max(0.0, end - time.monotonic()))
            return sum(answer.payload is not None for _, answer in owner.answers)
        finally:
            dialer.close()
            replica.kill()
            relay.close()


def main() -> None:
    most = int((REQUESTS * EVERY_S + TIMEOUT_S) * BYTES_PER_S / SIZE)
    print(f"{REQUESTS} requests; the uplink carries {most} of them at most")
    with mock.patch.object(DeadlineFilter, "may_arrive", return_value=True):
        print(f"in their order: {answered_in_time()} answered in time")
    print(f"what cannot arrive is declined: {answered_in_time()} answered in time")


if __name__ == "__main__":
    main()
