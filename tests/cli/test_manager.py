"""`fogft manager`, as a process of its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.cli.pools import lay_down


def test_a_manager_run_by_hand_tells_why_it_cannot(home: Path) -> None:
    """It ends as every command does: an error and a hint, no trace."""
    identity = lay_down(home, None).identity
    identity.write_text(identity.read_text().replace('"local"', '"mars"'))
    said = run_by_hand()
    assert said.startswith("error: there is no cloud `mars`\n\nhint: clouds: `local`, `sky`")
    identity.unlink()
    assert "error: there is no pool `planner`" in run_by_hand()


def run_by_hand() -> str:
    """Run it, which fails; return what it says."""
    words = [sys.executable, "-m", "fogft", "manager", "planner"]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ended.returncode == 1, ended.stderr
    return ended.stderr
