"""A replica that stood still, behind a relay that goes on connecting whoever has long given up."""

from __future__ import annotations

import signal
import time
from pathlib import Path

from fogft.link.zenoh.robot.dialer import ZenohDialer
from tests.link.thin_relay import ThinRelay
from tests.link.wire_pool import POOL_UID, Authority, Owner, ReplicaProcess, keys, peer, wait_for
from tests.needs import needs

pytestmark = needs("night")
LINKS = 4
STANDS_STILL_S = 40.0  # some seventy tries to connect, all given up


def test_links_of_one_address_are_back_soon_after_a_replica_goes_on(tmp_path: Path) -> None:
    """It ends the dead ones one by one, keeps their host out meanwhile, and lets the living in."""
    authority = Authority(tmp_path)
    replica = ReplicaProcess(authority.replica(0), slot=0)
    relay = ThinRelay(replica.endpoint)
    dialer = ZenohDialer(authority.robot(), robot="robot", pool_uid=POOL_UID)
    replica.signal(signal.SIGSTOP)
    links = [dialer.dial(peer(relay.endpoint), keys(0), Owner()) for _ in range(LINKS)]
    try:
        time.sleep(STANDS_STILL_S)
        assert not any(link.usable for link in links)
        replica.signal(signal.SIGCONT)
        wait_for(lambda: all(link.usable for link in links))
    finally:
        for link in links:
            link.close()
        relay.close()
        replica.kill()
