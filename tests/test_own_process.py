"""What is marked so runs elsewhere, and fails here where it fails there."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests import own_process

NOTED = "FOGFT_TEST_NOTES"
TESTS = f"""
import os, pytest

def note(name):
    with open(os.environ["{NOTED}"], "a") as notes:
        notes.write(f"{{name}} {{os.getpid()}}\\n")

def test_here():
    note("here")

@pytest.mark.own_process
@pytest.mark.parametrize("number", [1, 2])
def test_there(number):
    note("there")

@pytest.mark.own_process
def test_broken():
    assert "this" == "that"

@pytest.mark.own_process
def test_skipped():
    pytest.skip("for no reason")
"""


@pytest.mark.timeout(180)
def test_each_has_a_process_of_its_own_and_its_end_is_told(tmp_path, monkeypatch):
    """Also a skip that only shows there is no success here."""
    folder = own_process.ROOT / "tests" / f"_own_{os.getpid()}"
    folder.mkdir()
    file = folder / "test_tried.py"
    notes = tmp_path / "notes"
    try:
        file.write_text(TESTS)
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(file)],
            cwd=own_process.ROOT,
            env={**os.environ, NOTED: str(notes)},
            capture_output=True,
            text=True,
            check=False,
        )
    finally:
        for path in sorted(folder.rglob("*"), reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()
        folder.rmdir()
    assert "2 failed, 3 passed" in done.stdout, done.stdout
    assert "for no reason" in done.stdout or "1 skipped" in done.stdout
    where = [line.split() for line in notes.read_text().splitlines()]
    assert [name for name, _ in where] == ["here", "there", "there"]
    assert len({pid for _, pid in where}) == 3
    assert Path(f"/proc/{where[0][1]}").exists() is False
