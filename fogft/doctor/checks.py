"""All checks, in the order in which a person would look."""

from __future__ import annotations

from fogft.doctor import leftovers, machine, pools, ros
from fogft.doctor.finding import Check

ALL: tuple[Check, ...] = (*machine.CHECKS, *ros.CHECKS, *leftovers.CHECKS, *pools.CHECKS)
