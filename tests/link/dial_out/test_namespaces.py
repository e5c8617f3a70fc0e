"""Black holes, changed addresses and unreachable replicas, on real networks of the test's own.

Each of these has its counterpart over loopback (`test_rendezvous`, `test_dial_in`,
`tests/proxy/test_connectivity`), which runs without root.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest

from fogft.link.dial_out.replica import DialOut
from fogft.link.dial_out.robot import DialIn
from fogft.model.credentials import CredentialPaths
from fogft.model.replica import ReplicaId
from fogft.records.signing import Signer, Verifier
from tests.link.namespaces import inside
from tests.link.wire_pool import POOL_UID, SERVICE, request_id, wait_for
from tests.records.rendezvous_pool import Party, Rendezvous, manager_files

pytestmark = pytest.mark.timeout(180)

PLACE, ROBOT, MANAGER = "10.77.1.1", "10.77.1.2", "10.77.2.2"


@pytest.fixture
def party() -> Iterator[Callable[..., Party]]:
    made: list[Party] = []

    def make(where: str, files: CredentialPaths, endpoint: str) -> Party:
        with inside(where):
            made.append(Party(files, endpoint))
        return made[-1]

    yield make
    for one in made:
        one.client.close()


def test_a_blackholed_rendezvous_is_found_again_and_tells_what_joined(
    authority, net, party, record_property
):
    """Not a packet gets through, and nobody is told; TCP alone would wait for minutes.

    What joined meanwhile is known moments after the first packet that gets through. The time
    is recorded, not judged: this machine may be busy.
    """
    place, robot, other = net.add("p"), net.add("r"), net.add("m")
    net.join(place, PLACE, robot, ROBOT)
    net.join(place, "10.77.2.1", other, MANAGER)
    with inside(place):
        meeting = Rendezvous(authority, "a", endpoint="0.0.0.0:7450")
    try:
        ada = party(robot, authority.robot("ada"), f"{PLACE}:7450")
        manager = party(other, manager_files(authority), "10.77.2.1:7450")
        manager.admit(1, (0, 1))
        replica = party(other, authority.replica(0), "10.77.2.1:7450")
        replica.announce(0, 1, "10.77.2.2:7447")
        wait_for(lambda: ada.endpoint(0) == "10.77.2.2:7447")
        assert ada.client.known.seen_host == ROBOT
        net.blackhole(place, ROBOT)
        wait_for(lambda: ada.client.known.connected == 0)
        replica.announce(0, 1, "10.77.2.2:8888")
        manager.admit(2, (0, 1), (1, 1))
        wait_for(lambda: manager.orders().get(("admission", "")) == (1, 2))
        assert ada.endpoint(0) == "10.77.2.2:7447"
        net.restore(place, ROBOT)
        back = time.monotonic()
        wait_for(lambda: ada.endpoint(1) == "" and ada.endpoint(0) == "10.77.2.2:8888")
        record_property("known_after_s", round(time.monotonic() - back, 3))
    finally:
        meeting.kill()


def test_a_rendezvous_serves_on_when_one_caller_vanishes(authority, net, party):
    """The vanished one's connection is given up; the others notice nothing."""
    place, robot, other = net.add("p"), net.add("r"), net.add("m")
    net.join(place, PLACE, robot, ROBOT)
    net.join(place, "10.77.2.1", other, MANAGER)
    with inside(place):
        meeting = Rendezvous(authority, "a", endpoint="0.0.0.0:7450")
    try:
        party(robot, authority.robot("ada"), f"{PLACE}:7450")
        bob = party(other, authority.robot("bob"), "10.77.2.1:7450")
        manager = party(other, manager_files(authority), "10.77.2.1:7450")
        wait_for(lambda: meeting.status()["callers"] == 3)
        net.blackhole(place, ROBOT)
        wait_for(lambda: meeting.status()["callers"] == 2)
        manager.admit(1, (0, 1))
        wait_for(lambda: bob.endpoint(0) == "")
        assert bob.client.known.connected == 1
    finally:
        meeting.kill()


def test_a_replica_on_an_island_dials_out(
    authority, net, start_replica, dial, owner, record_property
):
    """It listens on its own loopback only: no route leads in. Its address changes under way."""
    lab, robot = net.add("l"), net.add("r")
    net.join(robot, ROBOT, lab, "10.77.1.3")
    id = ReplicaId(POOL_UID, 0, 1)
    files = authority.replica()
    with inside(robot):
        door = DialIn(f"{ROBOT}:7460", POOL_UID, Verifier(files.ca))
    with inside(lab):
        replica = start_replica(files=files)
        out = DialOut(replica.endpoint, POOL_UID, Signer(files.certificate, files.key))
        out.follow([f"{ROBOT}:7460"])
    try:
        link = dial(door.local(id))
        wait_for(lambda: link.usable)
        assert link.offer(SERVICE, request_id(1), b"first", 20.0)
        wait_for(lambda: owner.of(1))
        assert owner.of(1)[0].payload == b"first"
        net.readdress(lab, "ft1b", "10.77.1.3", "10.77.1.4")
        moved = time.monotonic()
        wait_for(lambda: not link.usable)
        wait_for(lambda: link.usable)
        record_property("resumed_after_s", round(time.monotonic() - moved, 3))
        assert link.offer(SERVICE, request_id(2), b"x" * 1_000_000, 20.0)
        wait_for(lambda: owner.of(2))
        assert owner.of(2)[0].payload == b"x" * 1_000_000
        net.blackhole(lab, ROBOT)
        wait_for(lambda: not link.usable)
        net.restore(lab, ROBOT)
        wait_for(lambda: link.usable)
    finally:
        out.close()
        door.close()
