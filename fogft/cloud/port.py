"""The port to a cloud. Every implementation passes `tests/contract`.

The cloud's own list is the record: machines carry the pool's uid, slot and generation,
and nothing that lacks the uid is ever touched.

Errors: `CloudUnreachable` when the cloud cannot tell, `NoCapacity` and `QuotaExceeded`
where they are known at once; a launch that fails later is listed as FAILED.
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
    # What the machine needs to serve: file name -> content. Holds ``replica.yaml``,
    # ``ca.crt``, ``replica.crt`` and ``replica.key``; the configuration names the others
    # relative to its own folder. Kept 0600.
    files: Mapping[str, bytes] = field(default_factory=dict)
    # Where the server proxy listens, on a cloud whose machines have addresses of their own.
    link_port: int = LINK_PORT
    # A machine of another type in the same place may cost so much at most; None for no limit.
    limit_usd_per_hour: float | None = None
    # Its machine exists and is stopped (`RealCloud.stop`): it is started under its id.
    is_there: bool = False
    # Others that are opened beside it.
    more_ports: tuple[int, ...] = ()
    # The replica dials its robots: nobody reaches it, so no port need be open.
    dials_out: bool = False
    # The networks that may connect to it, where the cloud can hold that; none for all.
    allow_from: tuple[str, ...] = ()


class Seller(Protocol):
    """A source of offers: a cloud, or a price table."""

    def offers(self, resources: Mapping[str, Any]) -> Sequence[Offer]:
        """List what can be bought for a task's `resources`.

        They hold ``ports: []`` where the machines need to be reached by nobody. Raises
        `CloudUnreachable` where prices cannot be had now, `SpecError` for what can never be met.
        """


class Cloud(Seller, Protocol):
    """Where replicas run."""

    def machines(self, pool_uid: str) -> Sequence[Machine]:
        """List this pool's machines in any phase, by id. CloudUnreachable: conclude nothing."""

    def launch(self, order: Launch) -> None:
        """Order a machine; return before it runs. Repeating an id does nothing.

        Once this has returned the machine is listed, though the caller may be killed.

        Raises:
            NoCapacity: The placement is full. Nothing was launched.
            QuotaExceeded: The account may not have more. Nothing was launched.
            CloudUnreachable: Unknown whether it was launched: look at `machines`.
        """

    def terminate(self, id: ReplicaId) -> None:
        """End a machine; return when it is gone. Repeatable. CloudUnreachable: it may run on."""

    def log(self, id: ReplicaId) -> str | None:
        """Return the path of the machine's log on this computer, if it is kept here."""


@runtime_checkable
class RealCloud(Protocol):
    """A cloud that costs money and needs credentials for each provider behind it."""

    def check(self, clouds: Sequence[str]) -> Mapping[str, str]:
        """Test credentials, of all clouds if none is named: cloud -> empty, or what to fix."""

    def check_task(self, task: Mapping[str, Any]) -> None:
        """Raise `SpecError` for what cannot be honoured on these clouds, before it is ordered."""

    def left_out(self) -> Sequence[str]:
        """Return, in sentences, what was left out of the offers because it cannot be launched."""

    def lacking(self, resources: Mapping[str, Any]) -> Mapping[str, str]:
        """Return what each cloud lacks for machines of a pool; empty where it lacks nothing."""

    def credentials_end_at(self) -> float | None:
        """Return when the first credentials expire, in seconds since the epoch; None: unknown."""

    def hindrances(self, clouds: Sequence[str], until: float | None) -> Sequence[str]:
        """Return, in sentences, what may make launches fail until a time; None for no limit."""

    def exposures(
        self, clouds: Sequence[str], *, open_port: int | None, allow_from: Sequence[str] = ()
    ) -> Sequence[str]:
        """Return, in sentences, unneeded credentials and open ports of machines there.

        `open_port`: the link's, None where replicas dial out. CloudError: it cannot be told now.
        """

    def unverified(self, cloud: str) -> str:
        """Return why a cloud's machines cannot be listed directly; empty when they can."""

    def stop(self, order: Launch) -> None:
        """Stop a machine; return when it is listed as that. Raises `CloudError`: it may run on."""

    def bake(self, task: Mapping[str, Any], image: str, folder: Path) -> None:
        """Write the build context of an image with a replica's environment into an empty folder.

        `task` has absolute paths; `image` is the base. SpecError: an image cannot have that.
        """


@dataclass(frozen=True)
class Audit:
    """The machines that exist, looked up without any cache."""

    machines: tuple[Machine, ...]  # in any phase, ordered by id
    # Clouds (as in `Placement.cloud`) whose own list was read. Of all others it is what was
    # remembered, or what somebody else says.
    asked: frozenset[str]


@runtime_checkable
class Auditing(Protocol):
    """A cloud that can list all machines that exist, even those fogft forgot."""

    def audit(self, pool_uid: str = "") -> Audit:
        """List the machines of a pool, or all of this user's. CloudUnreachable: it cannot tell."""


@runtime_checkable
class Refreshing(Protocol):
    """A cloud whose list is cached and may still show machines that are gone."""

    def refresh(self, id: ReplicaId) -> None:
        """Ask the provider about one machine, which takes seconds. Raises CloudUnreachable."""
