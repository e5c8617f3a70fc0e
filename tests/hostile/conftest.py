"""What those against hostile parties may use: certificates, replicas as processes, links."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from fogft.link.zenoh.robot.link import ZenohLink
from tests.link.conftest import authority, dial, owner, start_replica
from tests.link.wire_pool import ReplicaProcess, wait_for

__all__ = ["authority", "dial", "good", "owner", "replica", "start_replica"]


@pytest.fixture
def replica(start_replica: Callable[..., ReplicaProcess]) -> ReplicaProcess:
    """A replica that others attack."""
    return start_replica()


@pytest.fixture
def good(replica: ReplicaProcess, dial: Callable[..., ZenohLink]) -> ZenohLink:
    """The link of a robot that does nobody harm; its answers go to `owner`."""
    link = dial(replica.endpoint)
    wait_for(lambda: link.usable)
    return link
