"""The interface to a cloud provider's own API: machines with our labels, and prices.

SkyPilot's database can be lost; the provider's own list cannot.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from fogft.model.replica import Placement, ReplicaId


@dataclass(frozen=True)
class Instance:
    """A machine in the provider's list that carries our labels and still costs money."""

    id: ReplicaId
    key: str  # the provider's own id of the machine
    placement: Placement
    labels: Mapping[str, str]
    public_ip: str = ""
    launched_at: float = 0.0  # seconds since the epoch
    running: bool = True  # or starting; a stopped machine still costs money for its disk


class NotAllowedError(Exception):
    """The account lacks a permission. For machines, SkyPilot's list is used instead."""


class Provider(Protocol):
    """One cloud's own API. Optional methods default to "unknown". Thread-safe, with time limits.

    All raise `CloudUnreachable` if the cloud does not answer or may not have got the request,
    and `NotAllowedError` if the account lacks the permission.
    """

    cloud: str  # as in `Placement.cloud`

    def instances(self, regions: Iterable[str] | None, pool_uid: str = "") -> Sequence[Instance]:
        """List instances with our labels, of one pool (empty: all), in some regions (None: all)."""

    def terminate(self, instance: Instance) -> None:
        """Request the termination of an instance. No error if it is gone."""

    def end_when_shut_down(self, instance: Instance) -> None:
        """Make an on-demand machine terminate, rather than stop, when it shuts itself down."""
        return

    def firewall(self, region: str, ports: Iterable[int], sources: Iterable[str]) -> str:
        """Allow only some networks to reach some ports; return the rule's name, empty for none.

        Idempotent. Raises `CloudError` if a different rule has that name.
        """
        return ""

    def warning(self) -> str:
        """Return a warning about unneeded permissions of VMs; empty if none are known."""
        return ""

    def credentials_end_at(self) -> float | None:
        """Return when the local credentials expire, in seconds since the epoch; None: unknown."""
        return None

    def quota(self, region: str, code: str) -> float | None:
        """Return how many vCPUs the account may run in a region at once; None if unknown."""
        return None

    def spot_prices(self, region: str, instances: Iterable[str]) -> Mapping[tuple[str, str], float]:
        """Return live spot prices: (zone, instance type) -> US dollars per hour."""
        return {}
