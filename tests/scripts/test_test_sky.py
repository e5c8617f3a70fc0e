"""What cannot run here is skipped out loud: `scripts/test-sky`, and `.ci/run` after it."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SETUP = '#!/usr/bin/env bash\nwhile [ "$1" != -- ]; do shift; done\nshift\necho "ran: $*"\n'


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A project whose `scripts/setup` installs nothing and only says what it would run."""
    (tmp_path / "scripts").mkdir()
    (tmp_path / ".ci").mkdir()
    shutil.copy(ROOT / "scripts/test-sky", tmp_path / "scripts")
    shutil.copy(ROOT / ".ci/run", tmp_path / ".ci")
    program(tmp_path / "scripts/setup", SETUP)
    return tmp_path


def program(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)


def run(tree: Path, *words: str, **stubs: str) -> subprocess.CompletedProcess[str]:
    """Run a script of the tree, with programs that stand in for those of the machine."""
    folder = tree / "stubs"
    folder.mkdir(exist_ok=True)
    for name, text in stubs.items():
        program(folder / name, f"#!/bin/sh\n{text}\n")
    environ = {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}"}
    return subprocess.run(
        [tree / words[0], *words[1:]], env=environ, capture_output=True, text=True, check=False,
        timeout=60,
    )  # fmt: skip


def test_without_root_the_emulation_is_skipped_after_the_rest_was_tested(tree):
    done = run(tree, "scripts/test-sky", id="echo 1000")
    assert done.returncode == 77
    assert "python -m pytest" in done.stdout
    assert "world.sh" not in done.stdout
    assert "\nSKIPPED: " in done.stderr
    assert "root" in done.stderr


def test_without_namespaces_the_emulation_is_skipped(tree):
    done = run(tree, "scripts/test-sky", id="echo 0", unshare="exit 1")
    assert done.returncode == 77
    assert "namespaces" in done.stderr


def test_quick_needs_neither(tree):
    assert run(tree, "scripts/test-sky", "--quick", id="echo 1000").returncode == 0


def test_an_unknown_option_is_wrong_usage(tree):
    assert run(tree, "scripts/test-sky", "--slow").returncode == 2


@pytest.fixture
def ci(tree):
    """A tree in which all that `.ci/run` calls passes, and nothing is installed."""
    for name in ("check", "test", "quickstart", "soak", "test-sky"):
        program(tree / "scripts" / name, "#!/bin/sh\nexit 0\n")
    program(tree / "scripts/reproduce", '#!/bin/sh\necho "reproduce $*"\n')
    (tree / "stubs").mkdir()
    tools = dict.fromkeys(("apt-get", "g++", "cmake", "ninja", "npm"), "exit 0")
    for name, text in {**tools, "ldconfig": "echo libEGL.so.1"}.items():
        program(tree / "stubs" / name, f"#!/bin/sh\n{text}\n")
    return tree


@pytest.mark.parametrize(("status", "whole"), [(0, 0), (77, 0), (1, 1), (124, 1)])
def test_ci_goes_on_after_a_skip_and_fails_after_a_failure(ci, status, whole):
    program(ci / "scripts/test-sky", f"#!/bin/sh\nexit {status}\n")
    done = run(ci, ".ci/run")
    assert done.returncode == whole
    assert ("SKIPPED: scripts/test-sky" in done.stderr) is (status == 77)


def pip(tree: Path, text: str) -> None:
    (tree / ".venv/bin").mkdir(parents=True)
    program(tree / ".venv/bin/python", f"#!/bin/sh\n{text}\n")


def test_ci_runs_every_experiment_where_the_machine_can(ci):
    pip(ci, """echo '{"name": "torch"}'""")
    done = run(ci, ".ci/run")
    assert "reproduce --quick\n" in done.stdout
    assert "SKIPPED" not in done.stderr


@pytest.mark.parametrize(
    ("plan", "why"),
    [
        ("""echo '{"name": "torch"}, {"name": "nvidia-cublas-cu12"}'""", "all that GPUs need"),
        ("exit 1", "pip does not find"),
    ],
)
def test_ci_says_which_experiments_it_did_not_run_and_why(ci, plan, why):
    pip(ci, plan)
    done = run(ci, ".ci/run")
    assert done.returncode == 0
    assert "--only planning" in done.stdout
    assert "detection" not in done.stdout
    assert "SKIPPED: detection, segmentation and picking" in done.stderr
    assert why in done.stderr
