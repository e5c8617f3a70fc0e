"""What a machine of these tests serves."""

from __future__ import annotations

import sys
from pathlib import Path

# Without `site`: it needs the standard library only.
STAND_IN = (sys.executable, "-S", str(Path(__file__).with_name("stand_in.py")))
