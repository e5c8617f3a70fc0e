"""What is marked so runs elsewhere, and fails here where it fails there."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests import own_process, own_process_tried


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
