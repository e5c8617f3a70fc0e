"""What cannot run here is said: by `scripts/test-sky`, and by `.ci/run` and `.ci/nightly`."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.needs import NEEDS

ROOT = Path(__file__).parents[2]
SETUP = '#!/usr/bin/env bash\nwhile [ "$1" != -- ]; do shift; done\nshift\necho "ran: $*"\n'


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A project whose `scripts/setup` installs nothing and only says what it would run."""
    (tmp_path / "scripts").mkdir()
    (tmp_path / ".ci").mkdir()
    shutil.copy(ROOT / "scripts/test-sky", tmp_path / "scripts")
    for name in ("run", "nightly"):
        shutil.copy(ROOT / ".ci" / name, tmp_path / ".ci")
    program(tmp_path / "scripts/setup", SETUP)
    return tmp_path


def program(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)


def run(
    tree: Path, *words: str, more: Mapping[str, str] = {}, **stubs: str
) -> subprocess.CompletedProcess[str]:
    """Run a script of the tree, with programs that stand in for those of the machine."""
    folder = tree / "stubs"
    folder.mkdir(exist_ok=True)
    for name, text in stubs.items():
        program(folder / name, f"#!/bin/sh\n{text}\n")
    environ = {k: v for k, v in os.environ.items() if not k.startswith("FOGFT_")}
    environ |= {"PATH": f"{folder}:{os.environ['PATH']}", **more}
    return subprocess.run(
        [tree / words[0], *words[1:]], env=environ, capture_output=True, text=True, check=False,
        timeout=100,
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
    """A tree in which all that `.ci/run` calls passes and says so, and nothing is installed."""
    for name in ("check", "quickstart", "soak", "test-sky", "test-arm64", "reproduce", "fuzz"):
        program(tree / "scripts" / name, f'#!/bin/sh\necho "{name} $*"\n')
    program(
        tree / "scripts/test",
        '#!/bin/sh\necho "test on ${FOGFT_ROS:-jazzy} with $FOGFT_MUST_RUN"\n',
    )
    (tree / "stubs").mkdir()
    tools = dict.fromkeys(("apt-get", "g++", "cmake", "ninja", "npm"), "exit 0")
    for name, text in {**tools, "ldconfig": "echo libEGL.so.1"}.items():
        program(tree / "stubs" / name, f"#!/bin/sh\n{text}\n")
    return tree


@pytest.mark.parametrize(
    ("step", "status", "must", "whole"),
    [
        ("test-sky", 0, "pools-on-aws", 0),
        ("test-sky", 77, "tun", 0),
        ("test-sky", 77, "tun,pools-on-aws", 1),
        ("test-sky", 1, "", 1),
        ("test-sky", 124, "", 1),
        ("soak", 1, "", 1),
    ],
)
def test_ci_takes_every_step_and_fails_if_one_failed_or_did_not_run(ci, step, status, must, whole):
    program(ci / "scripts" / step, f"#!/bin/sh\necho its reason >&2\nexit {status}\n")
    done = run(ci, ".ci/run", more={"FOGFT_MUST_RUN": must})
    assert done.returncode == whole, done.stderr
    *_, reason, summary = done.stderr.rpartition("its reason")
    assert bool(reason) is (status not in {0, 77})
    assert summary.count(" ended with ") >= 8
    assert "reproduce --quick --only planning" in done.stdout
    assert ("not run: scripts/test-sky" in done.stderr) is (status == 77)
    assert "not run: detection, segmentation and picking: " in done.stderr


def test_ci_asks_for_what_the_tests_can_need(ci):
    """On both distributions; each name is one of `tests/needs.py`."""
    said = run(ci, ".ci/run").stdout
    asked = dict(re.findall("^test on (.+) with (.*)$", said, re.MULTILINE))
    names = {ros: set(filter(None, text.split(","))) for ros, text in asked.items()}
    assert {"namespaces", "rclpy"} <= names["jazzy"] <= set(NEEDS)
    assert {"rclpy", "test_msgs"} <= names["kilted"] <= set(NEEDS)


def pip(tree: Path, text: str) -> None:
    (tree / ".venv/bin").mkdir(parents=True)
    program(tree / ".venv/bin/python", f"#!/bin/sh\n{text}\n")


def test_at_night_all_that_the_machine_can_do_is_run(ci):
    pip(ci, """echo '{"name": "torch"}'""")
    done = run(ci, ".ci/nightly")
    assert done.returncode == 0, done.stderr
    assert "reproduce --quick\n" in done.stdout
    assert "fuzz" in done.stdout
    assert "test-arm64" in done.stdout
    modes = ("", "--adapter", "--alone", "--container", "--contract")
    assert all(f"test-sky {mode}\n" in done.stdout for mode in modes)
    assert "not run" not in done.stderr


@pytest.mark.parametrize(
    ("plan", "why"),
    [
        ("""echo '{"name": "torch"}, {"name": "nvidia-cublas-cu12"}'""", "all that GPUs need"),
        ("exit 1", "pip does not find"),
    ],
)
def test_a_night_says_which_experiments_it_did_not_run_and_why(ci, plan, why):
    pip(ci, plan)
    done = run(ci, ".ci/nightly")
    assert done.returncode == 0
    assert "--only planning" in done.stdout
    assert "detection" not in done.stdout
    assert "not run: detection, segmentation and picking" in done.stderr
    assert why in done.stderr
