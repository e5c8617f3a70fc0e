"""What the wire tests may use: certificates, replicas as processes, links that end with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from fogft.link.zenoh.robot.dialer import ZenohDialer
from fogft.link.zenoh.robot.link import ZenohLink
from tests.link.wire_pool import POOL_UID, Authority, Owner, ReplicaProcess, keys, peer


@pytest.fixture
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("pki"))


@pytest.fixture
def start_replica(authority: Authority) -> Iterator[Callable[..., ReplicaProcess]]:
    """Start a replica's process; its certificate is its own unless `files` says otherwise."""
    started: list[ReplicaProcess] = []

    def start(**options: Any) -> ReplicaProcess:
        slot, generation = options.get("slot", 0), options.get("generation", 1)
        files = options.pop("files", None) or authority.replica(slot, generation)
        started.append(ReplicaProcess(files, **options))
        return started[-1]

    yield start
    for replica in started:
        replica.kill()


@pytest.fixture
def owner() -> Owner:
    return Owner()


@pytest.fixture
def dial(authority: Authority, owner: Owner) -> Iterator[Callable[..., ZenohLink]]:
    """Dial a slot at an endpoint; options go to the dialer."""
    dialers: list[ZenohDialer] = []

    def start(endpoint: str, slot: int = 0, generation: int = 1, **options: Any) -> ZenohLink:
        options.setdefault("robot", "robot")
        options.setdefault("suspect_after_s", 10.0)  # a replica that is held up is not frozen
        files = options.pop("files", None) or authority.robot(options["robot"])
        to = options.pop("owner", owner)
        dialers.append(ZenohDialer(files, pool_uid=POOL_UID, **options))
        return dialers[-1].dial(peer(endpoint, slot, generation), keys(slot), to)

    yield start
    for dialer in dialers:
        dialer.close()
