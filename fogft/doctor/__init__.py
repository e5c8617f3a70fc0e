"""Checks of why a pool may not work on this machine, with a remedy for each.

A check is a function that yields findings. It never changes anything, and never raises
for what it looks for: a missing file is a finding. `run` turns a check's own failure
into a finding too, so that one broken check does not hide the others.

Owns: the checks.
Not here: how findings are shown (`fogft.cli.doctor`).
"""

from __future__ import annotations
