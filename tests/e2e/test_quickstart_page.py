"""The commands of docs/tutorial/first-pool.md, typed one after the other as the page has them."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.docs.documents import ROOT, console_commands
from tests.e2e.pool import Pool

pytestmark = [pytest.mark.e2e, pytest.mark.ros, pytest.mark.timeout(240)]


def commands_by_hand() -> list[str]:
    page = (ROOT / "docs" / "tutorial" / "first-pool.md").read_text()
    return console_commands(page.partition("\n## Start the pool\n")[2])


def test_the_quick_start_works_as_it_is_written(tmp_path, ros_domain):
    """Each command ends well, and the last one leaves no process."""
    pool = Pool(tmp_path, ros_domain)
    programs = tmp_path / "bin"
    programs.mkdir()
    for name, words in (("fogft", "-m fogft"), ("python", ""), ("python3", "")):
        (programs / name).write_text(f'#!/bin/sh\nexec {sys.executable} {words} "$@"\n')
        (programs / name).chmod(0o755)
    environ = {
        **pool.environ,
        "PATH": f"{programs}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "ROS_LOG_DIR": str(tmp_path / "ros-log"),
    }
    commands = commands_by_hand()
    assert commands[0].startswith("fogft init")
    assert commands[-1] == "fogft down"
    try:
        for command in commands:
            done = subprocess.run(
                ["bash", "-c", command],
                env=environ,
                cwd=tmp_path,
                capture_output=True,
                text=True,
                timeout=120,
                check=False,
            )
            assert done.returncode == 0, f"$ {command}\n{done.stdout}\n{done.stderr}"
        assert pool.left() == {}
    finally:
        pool.close()
