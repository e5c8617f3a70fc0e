"""The interface to a cloud. Every implementation passes `tests/contract`.

The cloud's own list of machines is the source of truth. Each machine is labelled with the pool's
uid, its slot and its generation; a machine without the uid is never touched.

Errors: `CloudUnreachable` if the cloud's answer is unknown; `NoCapacity` and `QuotaExceeded` if
they are known at once. A launch that fails later is listed as FAILED.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from fogft.model.names import LINK_PORT
from fogft.model.replica import Machine, Offer, Placement, ReplicaId


@dataclass(frozen=True)
class Launch:
    """An order for one machine."""

    id: ReplicaId
    pool: str  # the pool's name, for people
    placement: Placement
    usd_per_hour: float
    spec_hash: str
    # The SkyPilot task of the pool file, without its `fogft` section; paths are absolute.
    task: Mapping[str, Any] = field(default_factory=dict)
    # The server proxy's files: name -> content. The configuration ``replica.yaml`` names
    # ``ca.crt``, ``replica.crt`` and ``replica.key`` relative to its own folder. Mode 0600.
    files: Mapping[str, bytes] = field(default_factory=dict)
    # The port that the server proxy listens on, if each machine has an address of its own.
    link_port: int = LINK_PORT
    # The maximum price of another machine type in the same place; None for no limit.
    limit_usd_per_hour: float | None = None
    # The machine exists and is stopped (`RealCloud.stop`): start it under the same id.
    is_there: bool = False
    more_ports: tuple[int, ...] = ()
    # The replica dials its robots, so it needs no open port.
    dials_out: bool = False
    # The networks that may connect, if the cloud can enforce it; empty for all.
    allow_from: tuple[str, ...] = ()


class Seller(Protocol):
    """A source of offers: a cloud, or a price table."""

    def offers(self, resources: Mapping[str, Any]) -> Sequence[Offer]:
        """List the offers that satisfy a task's `resources`.

        `resources` has ``ports: []`` if nobody connects to the machines. Raises
        `CloudUnreachable` if prices are unavailable now, `SpecError` if no offer can ever match.
        """


class Cloud(Seller, Protocol):
    """A cloud that runs replicas."""

    def machines(self, pool_uid: str) -> Sequence[Machine]:
        """List a pool's machines in any phase, sorted by id. CloudUnreachable: conclude nothing."""

    def launch(self, order: Launch) -> None:
        """Launch a machine; return before it runs. Does nothing if the id was launched before.

        Once this returns, the machine is listed, even if the caller is killed afterwards.

        Raises:
            NoCapacity: The placement is full. Nothing was launched.
            QuotaExceeded: The account's quota is used up. Nothing was launched.
            CloudUnreachable: It is unknown whether it was launched: check `machines`.
        """

    def terminate(self, id: ReplicaId) -> None:
        """Terminate a machine; return when it is gone. Idempotent. CloudUnreachable: it may run."""

    def log(self, id: ReplicaId) -> str | None:
        """Return the path of the machine's log on this computer, if it is kept here."""


@runtime_checkable
class RealCloud(Protocol):
    """A cloud that costs money and needs credentials for each provider behind it."""

    def check(self, clouds: Sequence[str]) -> Mapping[str, str]:
        """Test the credentials of these clouds (all if empty): cloud -> empty, or what to fix."""

    def check_task(self, task: Mapping[str, Any]) -> None:
        """Raise `SpecError` if these clouds cannot honour the task. Called before a launch."""

    def left_out(self) -> Sequence[str]:
        """Return, in sentences, what was left out of the offers because it cannot be launched."""

    def lacking(self, resources: Mapping[str, Any]) -> Mapping[str, str]:
        """Return the features that each cloud lacks for a pool's machines; empty if none."""

    def credentials_end_at(self) -> float | None:
        """Return when the first credentials expire, in seconds since the epoch; None: unknown."""

    def hindrances(self, clouds: Sequence[str], until: float | None) -> Sequence[str]:
        """Return, in sentences, what may make launches fail before `until` (None: no limit)."""

    def exposures(
        self, clouds: Sequence[str], *, open_port: int | None, allow_from: Sequence[str] = ()
    ) -> Sequence[str]:
        """Return, in sentences, unneeded credentials and open ports of machines there.

        `open_port`: the link's port; None if replicas dial out. Raises CloudError: unknown now.
        """

    def unverified(self, cloud: str) -> str:
        """Return why a cloud's machines cannot be listed directly; empty when they can."""

    def stop(self, order: Launch) -> None:
        """Stop a machine; return when it is listed as stopped. Raises `CloudError`: it may run."""

    def bake(self, task: Mapping[str, Any], image: str, folder: Path) -> None:
        """Write the build context of an image with a replica's environment into an empty folder.

        `task` has absolute paths; `image` is the base. SpecError: an image cannot hold part of it.
        """


@dataclass(frozen=True)
class Audit:
    """The machines that exist, looked up without any cache."""

    machines: tuple[Machine, ...]  # in any phase, ordered by id
    # Clouds (as in `Placement.cloud`) whose own list was read. Machines on all other clouds are
    # listed from memory, or as a third party reports them.
    asked: frozenset[str]


@runtime_checkable
class Auditing(Protocol):
    """A cloud that can list all machines that exist, even those fogft forgot."""

    def audit(self, pool_uid: str = "") -> Audit:
        """List the machines of a pool, or all of this user's. Raises CloudUnreachable: unknown."""


@runtime_checkable
class Refreshing(Protocol):
    """A cloud whose list is cached and may still show machines that are gone."""

    def refresh(self, id: ReplicaId) -> None:
        """Ask the provider about one machine, which takes seconds. Raises CloudUnreachable."""
