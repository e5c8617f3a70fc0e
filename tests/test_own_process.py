"""What is marked so runs elsewhere, and fails here where it fails there."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fogft.cloud.local import processes
from tests import own_process, own_process_tried
from tests.fakes.waiting import wait_for


@pytest.mark.timeout(180)
def test_each_has_a_process_of_its_own_and_its_end_is_told(tmp_path):
    """Also a skip that only shows there is no success here."""
    notes = tmp_path / "notes"
    tried = str(Path(own_process_tried.__file__).relative_to(own_process.ROOT))
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", tried],
        cwd=own_process.ROOT,
        env={**os.environ, own_process_tried.NOTED: str(notes)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "2 failed, 3 passed" in done.stdout, done.stdout
    assert "for no reason" in done.stdout or "1 skipped" in done.stdout
    where = [line.split() for line in notes.read_text().splitlines()]
    assert [name for name, _ in where] == ["here", "there", "there"]
    assert len({pid for _, pid in where}) == 3
    assert Path(f"/proc/{where[0][1]}").exists() is False


ORDERS = """
import signal
from tests.link.forked import Forked
print(Forked("waits", [], 2).pid, flush=True)
signal.pause()
"""


def test_what_a_run_has_forked_ends_though_it_is_killed(tmp_path):
    (tmp_path / "waits.py").write_text("import signal\ndef main():\n    signal.pause()\n")
    environ = {**os.environ, "PYTHONPATH": f"{own_process.ROOT}{os.pathsep}{tmp_path}"}
    with subprocess.Popen(
        [sys.executable, "-c", ORDERS],
        env=environ, cwd=own_process.ROOT, stdout=subprocess.PIPE, text=True,
    ) as run:  # fmt: skip
        forked = int(run.stdout.readline())
        assert processes.alive(forked)
        run.kill()
    wait_for(lambda: not processes.alive(forked))
