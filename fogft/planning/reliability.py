"""How often a replica, and a pool of them, is down. Pure arithmetic.

A replica alternates between up (for `uptime_s` on average) and being replaced (for
`recovery_s`). A pool is down while all its replicas are, and for replicas that fail
independently that is the product of their unavailabilities. Real preemptions are
correlated, above all within a zone: treat the results as the best case.

Source: FogROS2-FT, section III.C. The paper prints the fraction for N upside down; its
own figures (15 h up, 20 min recovery: 2.17 % for one, 0.047 % for two) agree with this.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

# Decimal fractions are not exact in binary: without it, two replicas of 0.99 miss 0.9999.
_ROUNDING = 1 + 1e-9


def unavailability(uptime_s: float, recovery_s: float) -> float:
    """Return the fraction of time, in [0, 1), that one replica does not answer.

    Args:
        uptime_s: Mean time from ready to gone, in seconds, above 0.
        recovery_s: Mean time from gone to ready again elsewhere, in seconds, 0 or more.

    Raises:
        ValueError: An argument is out of range or not finite.
    """
    if not (math.isfinite(uptime_s) and uptime_s > 0):
        raise ValueError(f"uptime_s must be finite and above 0, not {uptime_s}")
    if not (math.isfinite(recovery_s) and recovery_s >= 0):
        raise ValueError(f"recovery_s must be finite and 0 or more, not {recovery_s}")
    return recovery_s / (uptime_s + recovery_s)


def system_unavailability(replicas: Iterable[float]) -> float:
    """Return the fraction of time that no replica answers.

    Args:
        replicas: The unavailability of each, in [0, 1]. Of none, nothing ever answers.

    Raises:
        ValueError: One is out of range.
    """
    product = 1.0
    for value in replicas:
        if not 0 <= value <= 1:
            raise ValueError(f"an unavailability must be from 0 to 1, not {value}")
        product *= value
    return product


def replicas_needed(availability: float, target: float, *, limit: int = 16) -> int:
    """Return the fewest replicas that together reach a target availability.

    All n are down with probability ``(1 - availability) ** n``.

    Args:
        availability: Fraction of time that one replica answers, in (0, 1].
        target: Fraction of time that at least one must answer, in (0, 1).
        limit: The most replicas to consider.

    Raises:
        ValueError: An argument is out of range, or ``limit`` is too low.
    """
    if not 0 < availability <= 1:
        raise ValueError(f"availability must be above 0 and at most 1, not {availability}")
    if not 0 < target < 1:
        raise ValueError(f"target must be above 0 and below 1, not {target}")
    allowed = (1 - target) * _ROUNDING
    for count in range(1, limit + 1):
        if (1 - availability) ** count <= allowed:
            return count
    raise ValueError(f"{limit} replicas of {availability:g} do not reach {target:g}")
