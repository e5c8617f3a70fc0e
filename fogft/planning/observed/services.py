"""Discover services for pool files that list none: those that most replicas advertise. Pure.

One replica of several changes nothing: it may be broken or compromised. Agreed services are kept
while the pool's version stays the same: a replica that dies removes no service from the robot.

Not here: what a replica offers (`fogft.proxy.replica.offering`), the file
(`fogft.pool.folder.discovered`).
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from fogft.model.plain import Count, Line
from fogft.model.replica import LinkState, MachinePhase, Observed
from fogft.model.ros_names import is_below
from fogft.model.spec import ServiceSpec


@dataclass(frozen=True)
class Discovered:
    """The discovered services."""

    spec_hash: Line = ""  # of the replicas that advertised them
    services: Mapping[Line, Line] = field(default_factory=dict)  # name -> type
    # How many replicas advertised when most of them last confirmed all services; 0 if not known.
    voters: Count = 0

    def specs(self, namespace: str = "") -> tuple[ServiceSpec, ...]:
        """Return the services below a namespace, with default policies."""
        return tuple(
            ServiceSpec(name, kind)
            for name, kind in sorted(self.services.items())
            if is_below(name, namespace)
        )


@dataclass(frozen=True)
class Claims:
    """The services that replicas of one hash advertise."""

    count: Mapping[tuple[str, str], int]  # how many offer a service: its name and type
    voters: int  # how many replicas the majority is counted from
    heard: int = 0  # how many advertise services

    def agreed(self) -> dict[str, str]:
        """Return name -> type of the services that more than half of the replicas offer."""
        return {name: kind for (name, kind), n in self.count.items() if 2 * n > self.voters}

    def outvoted(self) -> list[str]:
        """Return the names of the other services, sorted."""
        return sorted({name for name, _ in self.count} - self.agreed().keys())

    def doubtful(self, known: Discovered) -> frozenset[str]:
        """Return known services that most do not offer, if more replicas advertise than before.

        A replica that was alone at first may have lied, and then no other would ever be ready.
        """
        if self.heard <= known.voters:
            return frozenset()
        return frozenset(
            name
            for name, kind in known.services.items()
            if 2 * (self.heard - self.count.get((name, kind), 0)) > self.voters
        )


def claims(known: Discovered, spec_hash: str, observed: Observed, wanted: int) -> Claims:
    """Return the services that replicas of a hash advertise now.

    While no service is known, most of the existing machines decide, as others may be unavailable;
    later most of the wanted number, so that a replica that is alone for a while cannot decide.
    """
    ours = {
        machine.id
        for machine in observed.machines or ()
        if machine.spec_hash == spec_hash and machine.phase is not MachinePhase.FAILED
    }
    links = [link for link in observed.links or () if link.id in ours]
    heard = [link for link in links if link.state is LinkState.UP]
    count = Counter(pair for link in heard for pair in link.offered)
    told = sum(bool(link.offered) for link in heard)
    return Claims(count, max(len(ours), wanted if known.services else 0), told)


def grown(known: Discovered, spec_hash: str, now: Mapping[str, str], heard: int = 0) -> Discovered:
    """Return the discovered services extended by what replicas of a hash agree on."""
    if not now:
        return known
    if known.spec_hash != spec_hash:
        return Discovered(spec_hash, dict(now), heard)
    confirmed = known.services.keys() <= now.keys()
    voters = max(known.voters, heard) if confirmed else known.voters
    return Discovered(spec_hash, {**now, **known.services}, voters)
