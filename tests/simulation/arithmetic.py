"""How often one replica is down, by arithmetic alone: what simulations are compared with."""

from __future__ import annotations

import math

from fogft.planning.availability import unavailability
from fogft.simulation.model import MarketModel, Timing


def moving(model: MarketModel, timing: Timing) -> float:
    """Return the unavailability of a replica that is at once launched elsewhere when lost.

    It is away from its loss until its successor answers, the notice subtracted. That some
    location always has room is assumed.
    """
    recovery_s = timing.boot_s + timing.detect_s - timing.notice_s
    return unavailability(model.mttf_s, max(recovery_s, 0.0))


def staying(model: MarketModel, timing: Timing) -> float:
    """Return the unavailability of a replica that waits for room where it was.

    Of each time with room, exponential with mean `mttf_s`, the boot is lost.
    """
    return 1 - model.availability * math.exp(-timing.boot_s / model.mttf_s)
