"""What a test needs and is not here: the test is left out aloud, or fails where it must run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests import needs

ROOT = Path(__file__).parents[1]
TESTS = """
import pytest
from tests.needs import needs

@pytest.fixture
def never():
    raise AssertionError("a fixture of a test that is not run")

@needs("tun")
@pytest.mark.parametrize("number", [1, 2])
def test_left_out(number, never):
    pass

def test_run():
    pass
"""
HIDDEN = "from tests import needs\nneeds.NEEDS['tun'] = needs.Need(lambda: False, 'a tunnel')\n"


def run(folder: Path, must_run: str) -> tuple[int, str]:
    """Run the tests above where `tun` is missing."""
    (folder / "hidden.py").write_text(HIDDEN)
    (folder / "test_tried.py").write_text(TESTS)
    plugins = ("-p", "no:cacheprovider", "-p", "hidden", "-p", "tests.conftest")
    own = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", *plugins, "-c", ROOT / "pyproject.toml", folder],
        cwd=folder,
        env={**own, "FOGFT_MUST_RUN": must_run, "PYTHONPATH": f"{folder}:{ROOT}"},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("must_run", "code", "says"),
    [
        ("numpy", 0, "not run: 2 tests: needs tun: a tunnel"),
        ("numpy,tun", 1, "2 errors"),
        ("tunnel", 4, "FOGFT_MUST_RUN: unknown: tunnel"),
    ],
)
def test_what_is_missing_is_told_and_fails_where_it_must_run(tmp_path, must_run, code, says):
    status, said = run(tmp_path, must_run)
    assert (status, says in said) == (code, True), said


def test_a_misspelt_need_is_refused_where_it_is_written():
    with pytest.raises(AssertionError):
        needs.needs("namespace")
