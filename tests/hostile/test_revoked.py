"""A holder whose certificate was taken back: no replica lets it in, however new."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from fogft.link.zenoh.robot.dialer import ZenohDialer
from fogft.link.zenoh.robot.link import ZenohLink
from fogft.model.credentials import CredentialPaths, Role
from fogft.model.proxy_config import ServerProxyConfig
from fogft.model.replica import LinkState, Offer, Placement
from fogft.model.spec import PoolSpec, ServiceSpec
from fogft.planning.planner import PlannedLaunch
from fogft.pool.credentials import authority as pki
from fogft.pool.credentials.ledger import Ledger
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import Identity
from fogft.pool.manager import configuration
from fogft.pool.manager.announcing import ManagerRecords
from fogft.proxy.config import read_server
from fogft.records import cache
from fogft.records.record import Record, RecordKind, SignedRecord, sign_record
from fogft.records.roster import ServingLease
from fogft.records.signing import Signer
from tests.link.wire_pool import POOL_UID, Owner, ReplicaProcess, keys, peer, wait_for

SLOT, GENERATION = 3, 7
SPEC = PoolSpec("pool", (ServiceSpec("/echo", "std_srvs/srv/SetBool"),), task={"run": "serve"})


@pytest.fixture
def paths(tmp_path: Path) -> PoolPaths:
    made = PoolPaths(tmp_path)
    pki.create_authority(made.credentials, POOL_UID)
    return made


def _robot(paths: PoolPaths, name: str, *, revoked: bool) -> CredentialPaths:
    ledger = Ledger(paths.credentials)
    holder, issued = ledger.issue_next(Role.ROBOT, name, POOL_UID)
    pki.write(issued, paths.credentials, name)
    if revoked:
        ledger.revoke([holder])
    folder = paths.credentials
    return CredentialPaths(folder / "ca.crt", folder / f"{name}.crt", folder / f"{name}.key")


def _launched(paths: PoolPaths, manager: ManagerRecords | None = None) -> ServerProxyConfig:
    """What a replica is told that is launched now, as it reads it on its machine."""
    identity = Identity("pool", POOL_UID, "mock", str(paths.folder / "pool.yaml"), 0.0)
    planned = PlannedLaunch(SLOT, GENERATION, Offer(Placement("c", "r", "z", "i"), 0.2), "because")
    manager = manager or ManagerRecords(paths, POOL_UID, 1)
    told = manager.announcements(ServingLease(1e9, 60.0))
    order = configuration.build_order(paths, identity, SPEC, planned, told)
    machine = paths.folder / "machine"
    machine.mkdir()
    for name, content in order.files.items():
        (machine / name).write_bytes(content)
    return read_server(machine / "replica.yaml")


@pytest.fixture
def dial() -> Iterator[Callable[..., ZenohLink]]:
    dialers: list[ZenohDialer] = []

    def start(
        endpoint: str,
        files: CredentialPaths,
        robot: str,
        owner: Owner,
        told: Sequence[SignedRecord] = (),
    ) -> ZenohLink:
        dialers.append(ZenohDialer(files, robot=robot, pool_uid=POOL_UID))
        dialers[-1].tell(told)
        return dialers[-1].dial(peer(endpoint, SLOT, GENERATION), keys(SLOT), owner)

    yield start
    for dialer in dialers:
        dialer.close()


def test_a_replica_launched_later_never_lets_a_revoked_robot_in(
    paths: PoolPaths, dial: Callable[..., ZenohLink], start_replica: Callable[..., ReplicaProcess]
) -> None:
    """It knows before it listens: nobody has to tell it first, and others are let in at once."""
    eve, ada = _robot(paths, "eve", revoked=True), _robot(paths, "ada", revoked=False)
    config = _launched(paths)
    replica = start_replica(
        files=config.credentials, slot=SLOT, generation=GENERATION, records=config.announcements
    )
    hers, his = Owner(), Owner()
    shut_out = dial(replica.endpoint, eve, "eve", hers)
    wait_for(lambda: shut_out.status().detail == "our certificate is revoked")
    let_in = dial(replica.endpoint, ada, "ada", his)
    wait_for(lambda: let_in.usable)
    assert LinkState.UP not in {state for _, state in hers.states}
    assert replica.count("records_refused") == 0


def test_only_the_manager_prolongs_a_replica_s_life(
    paths: PoolPaths, dial: Callable[..., ZenohLink], start_replica: Callable[..., ReplicaProcess]
) -> None:
    """A robot's own lease is refused; one that it passes on counts, and a launch brings the first.

    So no robot, and nobody who has a robot's keys, can keep a machine running.
    """
    eve = _robot(paths, "eve", revoked=False)
    manager = ManagerRecords(paths, POOL_UID, 1)
    config = _launched(paths, manager)
    replica = start_replica(
        files=config.credentials, slot=SLOT, generation=GENERATION, records=config.announcements
    )
    assert replica.count("lease") == 1
    paths.announcements.write_bytes(manager.announcements(ServingLease(1e9 + 60.0, 60.0)))
    genuine = cache.read(paths.announcements)
    content = {"at": 1e9, "lasts_s": 1e7}
    forged = Record(POOL_UID, RecordKind.LEASE, "", 7, 7, content)
    signed = sign_record(forged, Signer(eve.certificate, eve.key))
    dial(replica.endpoint, eve, "eve", Owner(), (*genuine, signed))
    wait_for(lambda: replica.count("records_refused") == 1)
    wait_for(lambda: replica.count("lease") == 2)
    assert replica.count("records_refused") == 1


def test_a_list_that_a_robot_signed_takes_nobody_back(
    paths: PoolPaths, dial: Callable[..., ZenohLink], start_replica: Callable[..., ReplicaProcess]
) -> None:
    """Only the manager's signature counts: what lies on the machine has no other say."""
    eve, ada = _robot(paths, "eve", revoked=False), _robot(paths, "ada", revoked=False)
    config = _launched(paths)
    forged = paths.folder / "forged.json"
    cache.write(forged, [_signed_by(eve, "robot.ada.1." + POOL_UID)])
    replica = start_replica(
        files=config.credentials, slot=SLOT, generation=GENERATION, records=forged
    )
    link = dial(replica.endpoint, ada, "ada", Owner())
    wait_for(lambda: link.usable)
    assert replica.count("records_refused") == 1


def _signed_by(files: CredentialPaths, name: str) -> SignedRecord:
    record = Record(POOL_UID, RecordKind.REVOCATION, "", 9, 1, {"names": [name]})
    return sign_record(record, Signer(files.certificate, files.key))
