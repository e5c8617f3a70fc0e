"""Get a cloud's offers for each group of a pool.

Owns: assigning offers to groups.
Not here: what a cloud sells (`fogft.cloud`) and which is chosen (`fogft.planning.placement`).
"""

from dataclasses import replace

from fogft.cloud.port import Seller
from fogft.errors import SpecError
from fogft.model.groups import sales
from fogft.model.replica import Offer
from fogft.model.spec import PoolSpec
from fogft.planning.cost import GB, egress_bytes_per_s, egress_price


def ask(cloud: Seller, spec: PoolSpec) -> tuple[Offer, ...]:
    """Return all offers for a pool, each with its group's name."""
    found: list[Offer] = []
    places = {group.name: f"fogft.groups[{n}]." for n, group in enumerate(spec.groups)}
    for name, resources in sales(spec):
        try:
            sold = cloud.offers({**resources, "ports": []} if spec.dials_out else resources)
        except SpecError as error:
            if not error.key:
                raise
            key = places.get(name, "") + error.key
            raise SpecError.of_key(key, error.what, error.hint) from error
        found += [
            _priced(offer if offer.group == name else replace(offer, group=name), spec)
            for offer in sold
        ]
    return tuple(found)


def _priced(offer: Offer, spec: PoolSpec) -> Offer:
    """Return an offer with one replica's egress cost added, if the file gives its traffic."""
    price = egress_price(offer.placement.cloud)
    if not price or not any(one.traffic.response_bytes for one in spec.services):
        return offer
    egress = egress_bytes_per_s(spec.services, spec.replicas) * 3600 / GB * price
    total = offer.usd_per_hour + egress
    return replace(offer, usd_per_hour=total, egress_usd_per_hour=egress)
