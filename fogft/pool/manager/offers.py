"""Ask a cloud what is sold for each group of a pool.

Owns: telling whose offer is whose.
Not here: what a cloud sells (`fogft.cloud`) and which is chosen (`fogft.planning.placement`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

from fogft.errors import SpecError
from fogft.model.groups import sales
from fogft.model.replica import Offer
from fogft.model.spec import PoolSpec


class Seller(Protocol):
    """What has prices: a cloud, or a table of them."""

    def offers(self, resources: Mapping[str, Any]) -> Sequence[Offer]:
        """See `fogft.cloud.port.Cloud`."""


def ask(cloud: Seller, spec: PoolSpec) -> tuple[Offer, ...]:
    """Return all offers for a pool, each with the name of the group that it is for.

    Raises:
        CloudUnreachable: Prices cannot be had now.
        SpecError: The resources can never be met.
    """
    found: list[Offer] = []
    places = {group.name: f"fogft.groups[{n}]." for n, group in enumerate(spec.groups)}
    for name, resources in sales(spec):
        try:
            sold = cloud.offers(resources)
        except SpecError as error:
            raise SpecError(places.get(name, "") + error.message, error.hint) from error
        found += [offer if offer.group == name else replace(offer, group=name) for offer in sold]
    return tuple(found)
