"""A manager whose disk is full, or cannot be written: it stays, launches nothing, and goes on."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from fogft import disk
from fogft.model import intent
from fogft.model.replica import ReplicaId
from fogft.pool.commands import status
from tests.needs import needs
from tests.pool.scene import Scene

pytestmark = [needs("namespaces"), pytest.mark.timeout(120)]  # mounting needs root, as they do
ROUNDS_S = 6.0  # several rounds of a manager


@pytest.fixture
def small(tmp_path: Path) -> Iterator[Scene]:
    """A pool's home on a file system of 3 MB of its own."""
    home = tmp_path / "small"
    home.mkdir()
    options = "size=3m,mode=700"
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(home)], check=True)
    scene = Scene(home)
    try:
        yield scene
    finally:
        scene.close()
        subprocess.run(["umount", "--lazy", str(home)], check=True)


def fill(home: Path) -> Path:
    """Take all the room there is; return the file that took it."""
    filler = home / "filler"
    with filler.open("wb", buffering=0) as file:
        while shutil.disk_usage(home).free:  # who replaces a file frees a page
            with contextlib.suppress(OSError):
                file.write(bytes(4096))
    return filler


def scaled_by(scene: Scene, more: int) -> None:
    scene.store.write_intent(intent.scale(scene.store.intent(), scene.store.spec(), more, 0.0))


def beats(scene: Scene) -> int | None:
    return scene.paths.lease.stat().st_mtime_ns if disk.read_json(scene.paths.lease) else None


def lives_through_rounds(scene: Scene, manager: subprocess.Popen[bytes]) -> None:
    time.sleep(ROUNDS_S)
    assert manager.poll() is None, scene.output()
    assert scene.running() == ["0.1"]


def test_a_full_disk_ends_nothing_and_is_waited_out(small: Scene) -> None:
    """The replica serves on, the manager says what is wrong, and scales when there is room."""
    small.write(replicas=1)
    manager = small.start_manager()
    small.wait(lambda: small.whole(1))
    filler = fill(small.home)
    lives_through_rounds(small, manager)

    def says_so() -> bool:
        seen = status.read(small.paths, time.time())
        return not seen.stale and any("No space left" in one for one in seen.to_json()["notes"])

    small.wait(says_so)
    filler.unlink()
    scaled_by(small, 1)
    small.wait(lambda: small.whole(2))
    assert manager.poll() is None


def test_nothing_is_launched_while_the_disk_is_nearly_full(small: Scene) -> None:
    """Robots might never be told of the machine; status stays true, and says why it waits."""
    small.write(replicas=1)
    small.start_manager()
    small.wait(lambda: small.whole(1))
    filler = fill(small.home)
    os.truncate(filler, filler.stat().st_size - (32 << 10))  # room for small files alone
    small.cloud.terminate(ReplicaId(small.store.identity().uid, 0, 1))
    small.wait(lambda: any("full: nothing is launched" in n for n in small.status()["notes"]))
    assert (small.status()["replicas"], small.cloud.launched()) == ([], ["0.1"])
    filler.unlink()
    small.wait(lambda: small.whole(1))
    assert small.cloud.launched() == ["0.1", "0.2"]


def test_a_disk_that_is_read_only_for_a_while_is_waited_out(small: Scene) -> None:
    small.write(replicas=1)
    manager = small.start_manager()
    small.wait(lambda: small.whole(1))
    remount = ["mount", "-o", "remount,ro", str(small.home)]
    done = subprocess.run(remount, capture_output=True, text=True, check=False)
    if done.returncode:  # files that are open for writing keep it from becoming so
        subprocess.run(["mount", "-o", "remount,size=1k", str(small.home)], check=False)
    lives_through_rounds(small, manager)
    subprocess.run(["mount", "-o", "remount,rw,size=3m", str(small.home)], check=True)
    before = beats(small)
    small.wait(lambda: beats(small) != before)
    scaled_by(small, 1)
    small.wait(lambda: small.whole(2))
