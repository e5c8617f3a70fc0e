"""How `fogft status` draws who talks through whom: a tree for each robot. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from fogft.cli.table import Cell, milliseconds

_STATES = {"up": "good", "connecting": "soon", "suspect": "bad"}


def tree(topology: Mapping[str, Any], *, colour: bool) -> list[str]:
    """Return the lines of a status's topology; none where there are no gateways.

    How a link does is known for this machine's robot only, and for its own gateways.
    """
    if not topology:
        return []
    gateways = {one["name"]: one for one in topology["gateways"]}
    links = {one["name"]: one for one in topology["links"] if one["state"] == "up"}
    links = {**{one["name"]: one for one in topology["links"]}, **links}
    here, named = topology["robot"], topology["robots"]
    robots = {here or "this robot": named.get(here, topology["through"])}
    robots |= {name: through for name, through in named.items() if name != here}
    lines = [Cell("TOPOLOGY", "bold").painted(colour=colour)]
    for at, (robot, through) in enumerate(robots.items()):
        lines.append(f"robot {robot}")
        lines += _below(through, gateways, links if at == 0 else {}, colour=colour)
    if here and topology["through"] and len(robots) > 1:
        lines += ["all other robots"]
        lines += _below(topology["through"], gateways, {}, colour=colour)
    return lines


def _below(
    through: Sequence[str],
    gateways: Mapping[str, Any],
    links: Mapping[str, Any],
    *,
    colour: bool,
) -> list[str]:
    if not through:
        return ["└─ replicas"]
    lines = []
    for at, name in enumerate(through):
        last = at == len(through) - 1
        gateway = gateways[name]
        lines.append(f"{'└─' if last else '├─'} {_words(gateway, links.get(name), colour=colour)}")
        inset = "   " if last else "│  "
        lines += [inset + line for line in _below(gateway["through"], gateways, {}, colour=colour)]
    return lines


def _words(gateway: Mapping[str, Any], link: Mapping[str, Any] | None, *, colour: bool) -> str:
    words = [f"gateway {gateway['name']}", gateway["endpoint"]]
    if not gateway["generations"]:
        words.append(Cell("no certificate", "bad").painted(colour=colour))
    if link is not None:
        words.append(Cell(link["state"], _STATES.get(link["state"], "")).painted(colour=colour))
        if link["rtt_s"] is not None and link["state"] == "up":
            words.append(milliseconds(link["rtt_s"]))
        if link["detail"]:
            words.append(link["detail"])
    return "  ".join(words)
