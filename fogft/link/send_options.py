"""How the requests of each service are sent. Values only."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from fogft.model.choices import Compression, Freshness
from fogft.model.spec import ServiceSpec


@dataclass(frozen=True)
class SendOptions:
    """Which services want the newest first, no compression, or a deadline on the way.

    Attributes:
        latest: Those of which the newest request goes first.
        plain: Those whose payloads are never compressed.
        timed: Those whose requests nobody wants after their time. Of others, such as topics and the
            orders of a stateful service, it only says when they are sent again.
    """

    latest: frozenset[str] = frozenset()
    plain: frozenset[str] = frozenset()
    timed: frozenset[str] = frozenset()

    @classmethod
    def of(cls, services: Iterable[ServiceSpec]) -> SendOptions:
        """Return what these services want."""
        known = tuple(services)
        return cls(
            frozenset(s.name for s in known if s.freshness is Freshness.LATEST),
            frozenset(s.name for s in known if s.compression is Compression.OFF),
            frozenset(s.name for s in known if s.state is None),
        )


DEFAULT_OPTIONS = SendOptions()
