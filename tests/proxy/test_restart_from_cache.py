"""Every proxy starts again from the records on its own disk while no rendezvous is there.

Robots, a gateway and a server proxy as processes, without ROS. None is told anything but where
the rendezvous is: who is in, who goes through whom, which doors a replica has to dial, and who
is revoked stands in records only.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from fogft.model.replica import Member, Membership, ReplicaId
from fogft.model.topology import Gateway, RobotRoute, Topology
from fogft.records import cache
from fogft.records.record import RecordKind
from fogft.records.roster import admission_content
from tests.link.wire_pool import POOL_UID, wait_for
from tests.ports import free_port
from tests.proxy.gateway_pool import GatewayPool, Process, ServerProxy
from tests.records import certificate_names
from tests.records.rendezvous_pool import Party, Rendezvous, manager_files

pytestmark = pytest.mark.timeout(480)

LIMIT_S = 150.0
ID = ReplicaId(POOL_UID, 0, 1)
EVE = certificate_names.robot(POOL_UID, "eve")


class Scene:
    """One replica that dials out; `ada` behind gateway `edge`, `bob` by himself."""

    def __init__(self, folder: Path) -> None:
        self.pool = pool = GatewayPool(folder)
        self.rendezvous = Rendezvous(pool.authority, "a")
        self.manager = Party(manager_files(pool.authority), self.rendezvous.endpoint)
        at, door = f"127.0.0.1:{free_port()}", f"127.0.0.1:{free_port()}"
        topology = Topology((Gateway("edge", at, (), (1,)),), (RobotRoute("ada", ("edge",)),))
        admitted = Membership("p", POOL_UID, 2, 1, (Member(ID, ""),), topology=topology)
        say = self.manager.client.publish
        say(RecordKind.ADMISSION, "", 2, admission_content(admitted), sequence=1)
        say(RecordKind.REVOCATION, "", 2, {"names": [EVE]})
        dials = "dial_out: ['127.0.0.1:1']\n"  # who is where it learns from records
        self.replica = ServerProxy(pool, 0, dials + self._meeting("replica"))
        edge = pool.gateway("edge", listen=at, extra=self._meeting("edge") + self._door())
        self.ada = pool.robot("ada", extra=self._meeting("ada"))
        self.bob = pool.robot("bob", extra=self._meeting("bob") + self._door(door), first=1_000_000)
        self.proxies: tuple[Process | ServerProxy, ...] = (self.replica, edge, self.ada, self.bob)

    def _meeting(self, stem: str) -> str:
        return f"rendezvous: ['{self.rendezvous.endpoint}']\nrecords: {stem}-records.json\n"

    def _door(self, at: str = "") -> str:
        at = at or f"127.0.0.1:{free_port()}"
        return f"dial_in: {at}\ndial_in_listen: {at}\n"

    def cached(self, stem: str) -> int:
        """Return how many records a proxy has on its disk."""
        return len(cache.read(self.pool.folder / f"{stem}-records.json"))

    def serve(self) -> bool:
        """Whether both robots are answered, each request by its own answer."""
        for robot in (self.ada, self.bob):
            wait_for(robot.ready, LIMIT_S)
            robot.ask(20)
            robot.all_right()
        return True

    def close(self) -> None:
        self.manager.client.close()
        self.pool.close()
        self.replica.kill()
        self.rendezvous.kill()


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    made = Scene(tmp_path)
    yield made
    made.close()


def test_every_proxy_starts_again_while_no_rendezvous_is_there(scene):
    """All are killed and started anew: answers flow, and whoever was revoked stays out.

    Records are six: admission, revocation, the slot's, the gateway's, and two robots'.
    """
    assert scene.serve()
    stems = ("replica", "edge", "ada", "bob")
    wait_for(lambda: all(scene.cached(stem) == 6 for stem in stems), LIMIT_S)
    scene.manager.client.close()
    scene.rendezvous.kill()
    for proxy in scene.proxies:
        proxy.kill()
    for proxy in scene.proxies:
        proxy.start()
    assert scene.serve()
    eve = scene.pool.robot("eve")
    scene.pool.members[0] = Member(ID, scene.replica.endpoint)
    scene.pool.publish()
    wait_for(lambda: "our certificate is revoked" in str(eve.tell()["report"]["links"]), LIMIT_S)
