"""Find out why a pool cannot work here, and say what to do about each reason.

A check is a function that yields findings. It never changes anything, and never raises
for what it looks for: a missing file is a finding. `run` turns a check's own failure
into a finding too, so that one broken check does not hide the others.

Owns: the checks.
Not here: how findings are shown (`fogft.cli.doctor`).
"""

from __future__ import annotations
