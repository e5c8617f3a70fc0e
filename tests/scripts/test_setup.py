"""What `scripts/setup` says when it cannot work, and that it then changes nothing."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

# Stands for a Python: prints a version, fails where it is asked for what it does not have.
STUB = """#!/bin/bash
case "$2" in
    *version_info*) echo "{version}"; exit {unsupported} ;;
    *ensurepip*) exit {no_venv} ;;
    *rclpy*) exit 1 ;;
esac
exit {no_wheels}  # the check of the machine comes on standard input
"""


def setup(tmp_path: Path, python: str, **environ: str) -> subprocess.CompletedProcess[str]:
    kept = {k: v for k, v in os.environ.items() if k not in ("ROS_DISTRO", "AMENT_PREFIX_PATH")}
    environ = {
        **kept,
        "FOGFT_VENV": str(tmp_path / "venv"),
        "FOGFT_PYTHON": python,
        **environ,
    }
    return subprocess.run(
        [ROOT / "scripts" / "setup", "ros", "--", "echo", "ran"],
        env=environ,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )


def stub(tmp_path: Path, version: str, *, unsupported=0, no_venv=0, no_wheels=0) -> str:
    path = tmp_path / "stub-python"
    path.write_text(
        STUB.format(version=version, unsupported=unsupported, no_venv=no_venv, no_wheels=no_wheels)
    )
    path.chmod(0o755)
    return str(path)


def test_without_a_python_it_says_how_to_get_one(tmp_path):
    done = setup(tmp_path, "no-such-python")
    assert done.returncode == 1
    assert done.stderr.startswith("error: no Python 3.10 to 3.13 found\n\nhint: sudo apt install")


@pytest.mark.parametrize("version", ["3.9", "3.14"])
def test_an_unsupported_python_is_named(tmp_path, version):
    done = setup(tmp_path, stub(tmp_path, version, unsupported=1))
    assert done.returncode == 1
    assert f"is {version}" in done.stderr
    assert "FOGFT_PYTHON" in done.stderr


def test_a_python_without_venv_gets_the_exact_command(tmp_path):
    done = setup(tmp_path, stub(tmp_path, "3.12", no_venv=1))
    assert done.returncode == 1
    assert done.stderr == (
        "error: Python 3.12 is here, but its venv module is not\n\n"
        "hint: sudo apt install python3.12-venv\n"
    )


def test_a_machine_without_wheels_is_told_to_bring_ros(tmp_path):
    done = setup(tmp_path, stub(tmp_path, "3.12", no_wheels=1))
    assert done.returncode == 1
    assert "error: there are no ROS 2 wheels for this machine" in done.stderr
    assert "hint: install ROS 2" in done.stderr


def test_a_sourced_ros_whose_rclpy_cannot_be_imported_is_not_used(tmp_path):
    python = stub(tmp_path, "3.12", no_wheels=1)
    done = setup(tmp_path, python, ROS_DISTRO="noetic", AMENT_PREFIX_PATH="/opt/ros/noetic")
    assert "note: ROS 'noetic' is sourced" in done.stderr
    assert "using wheels instead" in done.stderr


def test_a_folder_that_is_no_environment_is_never_touched(tmp_path):
    """Somebody may point FOGFT_VENV at a folder of theirs."""
    theirs = tmp_path / "venv"
    theirs.mkdir()
    (theirs / "thesis.tex").write_text("years of work")
    done = setup(tmp_path, "python3")
    assert done.returncode == 1
    assert "is no virtual environment" in done.stderr
    assert (theirs / "thesis.tex").read_text() == "years of work"


@pytest.mark.parametrize("python", ["no-such-python", "stub"])
def test_a_failed_set_up_runs_no_command_and_leaves_nothing(tmp_path, python):
    done = setup(tmp_path, stub(tmp_path, "3.11", no_venv=1) if python == "stub" else python)
    assert "ran" not in done.stdout
    assert not (tmp_path / "venv").exists()


def test_a_distribution_without_wheels_is_refused(tmp_path):
    done = setup(tmp_path, "python3", FOGFT_ROS="humble")
    assert done.returncode == 1
    assert done.stderr == (
        "error: there are no wheels of ROS 2 'humble'\n\n"
        "hint: choose jazzy or kilted; another one is used where it is sourced\n"
    )
    assert not (tmp_path / "venv").exists()


def test_the_wheels_of_two_distributions_never_share_an_environment(tmp_path):
    """One of Fast DDS's versions would read the other's variables."""
    (tmp_path / "venv").mkdir()
    (tmp_path / "venv" / "pyvenv.cfg").write_text("include-system-site-packages = false\n")
    (tmp_path / "venv" / ".fogft-ros").write_text("jazzy\n")
    done = setup(tmp_path, stub(tmp_path, "3.11"), FOGFT_ROS="kilted")
    assert f"making {tmp_path / 'venv'} with Python 3.11" in done.stderr
