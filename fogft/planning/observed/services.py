"""Which services a pool offers whose file lists none: what its replicas advertise. Pure.

What was found is kept as long as the pool's replicas run the same: a replica that dies, or all of
them, takes no name from the robot. A changed file begins anew, once a replica that runs it has
told what it offers.

Owns: what is known, and how it grows.
Not here: what a replica offers (`fogft.proxy.replica.offering`), the file
(`fogft.pool.folder.discovered`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from fogft.model.replica import LinkReport, LinkState, Machine
from fogft.model.spec import ServiceSpec


@dataclass(frozen=True)
class Discovered:
    """What was found.

    Attributes:
        spec_hash: Of the replicas that told it.
        services: Name -> type.
    """

    spec_hash: str = ""
    services: Mapping[str, str] = field(default_factory=dict)

    def specs(self) -> tuple[ServiceSpec, ...]:
        """Return them with the policy that a pool file's service has unless told."""
        return tuple(ServiceSpec(name, kind) for name, kind in sorted(self.services.items()))


def offered(
    spec_hash: str, machines: Sequence[Machine], links: Sequence[LinkReport]
) -> dict[str, str]:
    """Return name -> type of what the replicas of a hash offer now; the lowest slot's type wins."""
    ours = {machine.id for machine in machines if machine.spec_hash == spec_hash}
    found: dict[str, str] = {}
    for link in sorted(links, key=lambda link: link.id):
        if link.id in ours and link.state is LinkState.UP:
            for name, kind in link.offered:
                found.setdefault(name, kind)
    return found


def grown(known: Discovered, spec_hash: str, now: Mapping[str, str]) -> Discovered:
    """Return what is known after replicas of a hash offered this."""
    if not now:
        return known
    before = known.services if known.spec_hash == spec_hash else {}
    return Discovered(spec_hash, {**now, **before})
