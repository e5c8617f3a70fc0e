"""The quick start's last check finds what a pool left, and nothing else."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[2] / "scripts" / "quickstart_leftovers.py"
UID = "0123456789abcdef"


@pytest.fixture(scope="module")
def leftovers():
    spec = importlib.util.spec_from_file_location("quickstart_leftovers", SOURCE)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look themselves up there
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.fixture
def places(leftovers, tmp_path, monkeypatch):
    """Empty folders in place of the machine's own."""
    for name in ("home", "tmp", "shm"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    monkeypatch.setattr(leftovers, "SHARED_MEMORY", tmp_path / "shm")
    monkeypatch.setattr(leftovers, "GRACE_S", 0.0)
    return tmp_path


def sleeper(**environ: str) -> subprocess.Popen[bytes]:
    """Start a process that has this environment, and wait until the kernel shows it.

    `Popen` returns while the kernel is still laying out the new program: until it has
    done so, ``/proc/PID/environ`` is empty.
    """
    process = subprocess.Popen(["sleep", "60"], env={**os.environ, **environ})
    while not Path(f"/proc/{process.pid}/environ").read_bytes():
        assert process.poll() is None
    return process


def test_a_process_with_the_pools_home_is_found_until_it_ends(leftovers, tmp_path):
    process = sleeper(FOGFT_HOME=str(tmp_path))
    try:
        assert [p.split()[1] for p in leftovers.processes(tmp_path)] == [str(process.pid)]
        assert leftovers.processes(tmp_path / "other") == []
    finally:
        process.kill()
        process.wait()
    assert leftovers.processes(tmp_path) == []


def test_a_machine_of_the_pool_is_found_by_its_uid(leftovers, tmp_path):
    identity = tmp_path / "pools" / "planner" / "pool.json"
    identity.parent.mkdir(parents=True)
    identity.write_text(json.dumps({"name": "planner", "uid": UID}))
    process = sleeper(FOGFT_POOL_UID=UID)
    try:
        assert len(leftovers.processes(tmp_path)) == 1
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize(
    "name", ["tmp/fogft", "shm/fastdds_0123abcd", "home/.ros", "shm/sem.fastdds_port60007_mutex"]
)
def test_new_files_of_ours_are_found(leftovers, places, name):
    before = leftovers.Before.now()
    (places / name).write_text("")
    assert before.left_behind(places / "none") == [str(places / name)]


def test_what_was_there_and_what_is_anothers_is_not_ours(leftovers, places):
    (places / "tmp" / "fogft").write_text("")
    before = leftovers.Before.now()
    (places / "tmp" / "fogft-test-of-somebody").write_text("")
    assert before.left_behind(places / "none") == []


def test_the_domain_is_one_where_nobody_listens(leftovers):
    assert leftovers.free_ros_domain() in leftovers.DOMAINS
