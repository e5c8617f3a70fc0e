"""What is loaded, and when: a command line that starts at once."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

HEAVY = {"zenoh", "sky", "rclpy", "cryptography", "boto3", "numpy", "rich", "yaml"}


def loaded(code: str) -> set[str]:
    """Run code in a fresh Python; return the top-level modules that it loaded."""
    report = "import sys, json; print(); print(json.dumps([m.split('.')[0] for m in sys.modules]))"
    ended = subprocess.run(
        [sys.executable, "-c", f"{code}\n{report}"], capture_output=True, text=True, check=True
    )
    return set(json.loads(ended.stdout.splitlines()[-1]))


@pytest.mark.parametrize(
    "code",
    [
        "import fogft",
        "import fogft.pool.commands.composition",
        "import fogft.cli.main",
        "from fogft.cli import main; assert main.run(['--help']) == 0",
        "from fogft.cli import main; assert main.run(['up', '--help']) == 0",
        "from fogft.cli import main; assert main.run(['--version']) == 0",
    ],
)
def test_nothing_heavy_is_loaded(code):
    assert loaded(code) & HEAVY == set()
