"""The provider itself, asked directly: what exists with our labels, and what it costs.

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
    key: str  # the provider's own name of it
    placement: Placement
    labels: Mapping[str, str]
    public_ip: str = ""
    launched_at: float = 0.0  # seconds since the epoch
    running: bool = True  # or about to; a stopped one's disk still costs


class NotAllowedError(Exception):
    """This account may not list machines: SkyPilot's list has to do."""


class Provider(Protocol):
    """One cloud, by its own interface: what is left out is not known. From any thread, with limits.

    All raise `CloudUnreachable` when the cloud cannot tell, or it is not known whether it heard,
    and `NotAllowedError` where the account may not.
    """

    cloud: str  # as in `Placement.cloud`

    def instances(self, regions: Iterable[str] | None, pool_uid: str = "") -> Sequence[Instance]:
        """List what has our labels, of one pool or (empty) all, in some regions or (None) all."""

    def terminate(self, instance: Instance) -> None:
        """Ask for the end of an instance. One that is gone is no error."""

    def end_when_shut_down(self, instance: Instance) -> None:
        """Have a machine on demand end, and not merely stop, when it shuts itself down."""
        return

    def firewall(self, region: str, ports: Iterable[int], sources: Iterable[str]) -> str:
        """Let only some networks reach some ports; return the rule's name, empty for none.

        Repeatable. Raises `CloudError` where something else goes by that name.
        """
        return ""

    def warning(self) -> str:
        """Return what a VM there may do that it need not; empty where nothing is known."""
        return ""

    def credentials_end_at(self) -> float | None:
        """Return when the credentials here end, in seconds since the epoch; None for unknown."""
        return None

    def quota(self, region: str, code: str) -> float | None:
        """Return how many vCPUs an account may run there at once; None where that is unknown."""
        return None

    def spot_prices(self, region: str, instances: Iterable[str]) -> Mapping[tuple[str, str], float]:
        """Return live spot prices: (zone, instance type) -> US dollars per hour."""
        return {}
