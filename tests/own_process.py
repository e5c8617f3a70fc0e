"""Tests that need a process of their own: `@pytest.mark.own_process`.

Zenoh's threads serve all sessions of a process, and stay in the network namespace in which they
began. A test that opens sessions in a namespace would leave such threads to all tests after it,
whose connections would then be looked for there: in vain.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import tempfile
from pathlib import Path

import pytest

from tests.link import forked

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
    with tempfile.TemporaryFile("w+") as said:
        given = json.dumps([["-o", stacks, *command], {**kept, _INSIDE: item.nodeid}])
        process = forked.Forked("tests.own_process_forked", [given], said.fileno())
        process.stdin.close()
        process.stdout.close()
        try:
            code = process.wait(limit_s - _TO_TELL_S)
        except subprocess.TimeoutExpired:
            process.kill()
            said.seek(0)
            pytest.fail(f"hangs in a process of its own:\n{said.read()}", pytrace=False)
        said.seek(0)
        told = said.read()
    if code or "\n1 passed" not in told:
        pytest.fail(f"in a process of its own:\n{told}", pytrace=False)
    return True
