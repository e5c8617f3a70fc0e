"""A service type of one's own: built by colcon, found on both sides, and held equal."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from fogft import template_files
from fogft.pool.commands import init
from tests.e2e.pool import Pool
from tests.needs import needs

pytestmark = [pytest.mark.e2e, pytest.mark.ros, pytest.mark.timeout(400)]

PATH = f"{Path(sys.prefix, 'bin')}:{os.environ.get('PATH', '')}"


def build(folder: Path, environ: dict[str, str]) -> None:
    done = subprocess.run(
        ["bash", str(template_files.folder() / "workspace.sh")],
        cwd=folder, env={**environ, "PATH": PATH}, capture_output=True, text=True, timeout=300,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


def source(folder: Path, environ: dict[str, str]) -> dict[str, str]:
    """Return the environment after sourcing a workspace."""
    words = ["bash", "-c", f". {folder}/install/setup.bash; env -0"]
    out = subprocess.run(words, env=environ, capture_output=True, text=True, check=True).stdout
    return dict(line.split("=", 1) for line in out.split("\0") if "=" in line)


def other_definition(folder: Path, into: Path) -> Path:
    """Copy the generated code, and have it say that `words` is a longer number."""
    [package] = folder.glob("install/word_interfaces/lib/python*/site-packages")
    shutil.copytree(package, into)
    code = into / "word_interfaces" / "srv" / "_count_words.py"
    told = code.read_text()
    assert "'words': 'uint32'" in told
    code.write_text(told.replace("'words': 'uint32'", "'words': 'uint64'"))
    return into


@needs("build")
def test_own_types_are_built_found_and_held_equal(pool: Pool, tmp_path: Path):
    workspace = tmp_path / "workspace"
    init.copy_example("words", workspace)
    pool.file = workspace / "pool.yaml"
    pool.file.write_text(pool.file.read_text().replace("replicas: 2", "replicas: 1"))
    said = pool.fogft("up", str(pool.file), "--yes", ok=False)
    assert "there is no package `word_interfaces` with services here" in said
    assert "source its workspace" in said

    build(workspace, pool.environ)
    bare, pool.environ = pool.environ, source(workspace, pool.environ)
    pool.fogft("up", str(pool.file), "--yes", limit_s=200)
    words = [sys.executable, str(workspace / "count_client.py"), "one two", "three"]
    done = subprocess.run(
        words, env=pool.environ, capture_output=True, text=True, timeout=100, check=False
    )
    assert (done.stdout, done.returncode) == ("3 words, 11 letters\n", 0), done.stderr

    # The robot's own copy says something else; the replica goes on with what it built.
    pool.kill_robot_side()
    other = other_definition(workspace, tmp_path / "other")
    libraries = workspace / "install" / "word_interfaces" / "lib"
    pool.environ = dict(bare)
    for key, place in (("PYTHONPATH", other), ("LD_LIBRARY_PATH", libraries)):
        pool.environ[key] = f"{place}:{bare.get(key, '')}"
    said = pool.fogft("up", str(pool.file), "--yes", ok=False, limit_s=200)
    assert "cannot answer: robot and replicas disagree on its type" in said
    assert "field `response.words` is `uint64` here and `uint32` on the replica" in said


@needs("build")
def test_what_was_built_elsewhere_is_not_trusted(pool: Pool, tmp_path: Path):
    """A workspace that travels with its `install` folder is built anew where it arrives."""
    fake = tmp_path / "bin"
    fake.mkdir()
    builds = "mkdir -p install && echo $PWD/install >install/setup.sh"
    (fake / "colcon").write_text(f"#!/bin/sh\n{builds}\n")
    (fake / "colcon").chmod(0o755)
    workspace = tmp_path / "workspace"
    (workspace / "src").mkdir(parents=True)
    install = workspace / "install"
    install.mkdir()
    (install / "setup.sh").write_text("COLCON_CURRENT_PREFIX=/home/robot/workspace/install\n")
    (install / "left").touch()
    environ = {**os.environ, "PATH": f"{fake}:{PATH}", "ROS_DISTRO": "any"}
    for left in (False, True):
        subprocess.run(
            ["bash", str(template_files.folder() / "workspace.sh")],
            cwd=workspace, env=environ, check=True, timeout=100,
        )  # fmt: skip
        assert (install / "left").exists() is left
        (install / "left").touch()
