"""Which of a robot's uplinks a request takes. Pure."""

from __future__ import annotations

import re
from collections.abc import Sequence
from enum import Enum

_INTERFACE = re.compile(r"[A-Za-z0-9._-]{1,15}")


class UplinkPolicy(str, Enum):
    """How a service's requests use several uplinks."""

    PREFER = "prefer"  # the first that is up, in the order listed
    FAILOVER = "failover"  # one until it fails, then the next; no way back before that one fails
    ALL = "all"  # every one, at once


def is_interface(name: str) -> bool:
    """Whether this can be the name of a network interface on Linux."""
    return bool(_INTERFACE.fullmatch(name)) and name not in (".", "..")


def choose(
    policy: UplinkPolicy, usable: Sequence[int], current: int | None
) -> tuple[Sequence[int], int | None]:
    """Return which of the usable uplinks a request takes, and which is current from now on.

    Args:
        usable: Uplinks that are up and not on the request already, as listed in the pool file.
        current: The one that `failover` uses; None before the first.
    """
    if policy is UplinkPolicy.ALL or not usable:
        return usable, current
    if policy is UplinkPolicy.FAILOVER and current is not None and current in usable:
        return (current,), current
    later = [one for one in usable if current is not None and one > current]
    chosen = later[0] if policy is UplinkPolicy.FAILOVER and later else usable[0]
    return (chosen,), chosen
