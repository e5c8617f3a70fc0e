"""A replica in wrong hands: a real server proxy with a good certificate that lies as a file says.

    python -m tests.hostile.serve WORDS... serve --config replica.yaml

stands in for ``fogft``. ``$FOGFT_HOSTILE`` names a file that is looked at with each request; while
it is missing or says ``honest``, the replica is one like any other.

=================  ==============================================================================
``junk BYTES``     each request is answered at once, with so many random bytes
``crashed``        each is refused at once: the service is said to have died over it
``refused``        each is refused at once, for one reason after the other
``swallowed``      each is accepted, and never answered
``boasting``       the same, and each tenth is refused with the word that there is nothing to do
``claims``         probes are told of services that nobody has, and of none that there are
``escapes``        probes are told a text that means something to a terminal
=================  ==============================================================================
"""

from __future__ import annotations

import os
import random
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from fogft.cli import main as cli
from fogft.link.port import Incoming, Probe, ProbeAnswer
from fogft.link.zenoh.replica import listener
from fogft.model.refusal import Refusal
from fogft.requests.load import Load
from tests.hostile.orders import CLAIMED, ESCAPES, HOSTILE

IDLE = Load(0, 0, 64, 0.0, 0.0)
REFUSALS = tuple(Refusal)


class Hostile:
    """Lies to robots in place of what a server proxy would say."""

    def __init__(self, orders: Path) -> None:
        self._orders = orders
        self._asked = 0
        self._kept: list[Incoming] = []

    def kind(self) -> tuple[str, int]:
        """Return what is to be done now, with its number."""
        try:
            name, _, number = self._orders.read_text().strip().partition(" ")
        except OSError:
            return "honest", 0
        return name, int(number or 0)

    def takes(self, incoming: Incoming) -> bool:
        """Treat a request badly; return whether that was done."""
        kind, number = self.kind()
        self._asked += 1
        if kind == "junk":
            incoming.reply(random.randbytes(number), load=IDLE)
        elif kind == "crashed":
            incoming.refuse(Refusal.CRASHED, load=IDLE)
        elif kind == "refused":
            incoming.refuse(REFUSALS[self._asked % len(REFUSALS)], "7", load=IDLE)
        elif kind == "boasting" and self._asked % 10 == 0:
            incoming.refuse(Refusal.OVERLOADED, load=IDLE)
        elif kind in ("swallowed", "boasting"):
            self._kept.append(incoming)  # one that is let go of is refused
        return kind in ("junk", "crashed", "refused", "boasting", "swallowed")

    def tells(self, answer: ProbeAnswer) -> ProbeAnswer:
        """Return what a probe is told instead."""
        kind, _ = self.kind()
        if kind == "claims":
            offered = {CLAIMED: "std_srvs/srv/Trigger"}
            return replace(answer, offered=offered, ready=frozenset(offered))
        return replace(answer, detail=ESCAPES) if kind == "escapes" else answer


def patch(hostile: Hostile) -> None:
    """Have every listener of this process lie."""
    serve = listener.ZenohListener.serve

    def serves(
        self: listener.ZenohListener,
        services: Mapping[str, str],
        on_request: Callable[[Incoming], None],
        on_probe: Callable[[Probe], ProbeAnswer],
        on_cancel: Callable[[Sequence[bytes]], None] = lambda ids: None,
    ) -> None:
        def requested(incoming: Incoming) -> None:
            if not hostile.takes(incoming):
                on_request(incoming)

        serve(self, services, requested, lambda probe: hostile.tells(on_probe(probe)), on_cancel)

    listener.ZenohListener.serve = serves  # type: ignore[method-assign]


if __name__ == "__main__":
    patch(Hostile(Path(os.environ[HOSTILE])))
    cli.main(sys.argv[1:])
