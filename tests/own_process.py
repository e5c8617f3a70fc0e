"""Tests that need a process of their own: `@pytest.mark.own_process`.

Zenoh's threads serve all sessions of a process, and stay in the network namespace in which they
began. A test that opens sessions in a namespace would leave such threads to all tests after it,
whose connections would then be looked for there: in vain.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
_INSIDE = "FOGFT_TEST_IN_OWN_PROCESS"
_USUAL_LIMIT_S = 120.0
_TO_TELL_S = 15.0  # of a test's time, to say where it hangs
# What xdist and pytest tell their workers is not for another pytest.
_NOT_PASSED_ON = re.compile("PYTEST_")


def run(item: pytest.Item) -> bool:
    """Run a marked test in another process; False where it is to be run in this one.

    Its fixtures are made in both, so that what is skipped there is skipped here.
    """
    if item.get_closest_marker("own_process") is None or os.environ.get(_INSIDE) == item.nodeid:
        return False
    kept = {name: value for name, value in os.environ.items() if not _NOT_PASSED_ON.match(name)}
    command = ["-q", "-p", "no:xdist", "-p", "no:cacheprovider", "-o", "addopts=", item.nodeid]
    marker = item.get_closest_marker("timeout")
    limit_s = float(marker.args[0]) if marker else _USUAL_LIMIT_S
    stacks = f"faulthandler_timeout={limit_s - 2 * _TO_TELL_S}"
    try:
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-o", stacks, *command],
            cwd=ROOT,
            env={**kept, _INSIDE: item.nodeid},
            capture_output=True,
            text=True,
            check=False,
            timeout=limit_s - _TO_TELL_S,
        )
    except subprocess.TimeoutExpired as hung:
        told = "\n".join((said or b"").decode() for said in (hung.stdout, hung.stderr))
        pytest.fail(f"hangs in a process of its own:\n{told}", pytrace=False)
    if done.returncode or "\n1 passed" not in done.stdout:
        pytest.fail(f"in a process of its own:\n{done.stdout}\n{done.stderr}", pytrace=False)
    return True
