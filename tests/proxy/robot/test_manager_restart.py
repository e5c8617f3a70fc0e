"""A manager that was killed is started again, and no other one."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from fogft import disk
from fogft.errors import StateError
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.manager import proxy_supervisor
from fogft.proxy.robot.manager_restart import HANGS_AFTER_S, LOOK_S, NAME, ManagerRestart


class Scene:
    def __init__(self, folder: Path) -> None:
        self.paths = PoolPaths(folder)
        self.now = 100.0
        environ = {**os.environ, "WORD": "said"}
        self.restart = ManagerRestart(folder, environ, lambda: self.now)
        proxy_supervisor.allow_restart(self.paths, {})
        told = disk.read_json(self.paths.manager_start)
        code = "import os; print(os.environ['WORD'], os.getcwd())"
        told |= {"command": [sys.executable, "-c", code]}
        disk.write_json(self.paths.manager_start, told)

    def looks(self, count: int) -> bool:
        """Look so often, each when it is due; return whether one was started."""
        before = self.restart.child
        for _ in range(count):
            self.now += LOOK_S
            self.restart.look()
        return self.restart.child is not before


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path)


def test_a_missing_manager_is_started_as_it_was_and_again_less_and_less_often(scene):
    """From its own folder, with the environment of old; not when it is missing for an instant."""
    assert scene.paths.manager_start.name == NAME
    assert not scene.looks(1)
    starts = []
    for number in range(60):
        if scene.looks(1):
            starts.append(number)
            assert scene.restart.child.wait(20) == 0
    assert starts[0] == 0
    assert [b - a for a, b in itertools.pairwise(starts)] == [1, 2, 4, 8, 16]
    assert scene.paths.manager_log.read_text().splitlines()[0] == f"said {os.getcwd()}"


def test_one_whose_folder_is_gone_is_started_in_the_pools(scene, tmp_path):
    told = disk.read_json(scene.paths.manager_start)
    disk.write_json(scene.paths.manager_start, told | {"folder": str(tmp_path / "gone")})
    assert scene.looks(2)
    assert scene.restart.child.wait(20) == 0
    assert scene.paths.manager_log.read_text() == f"said {tmp_path}\n"


@pytest.mark.parametrize("held", ["manager_lock", "intent_lock"])
def test_one_that_lives_or_a_pool_that_is_being_ended_is_let_be(scene, held):
    with disk.locked(getattr(scene.paths, held)):
        assert not scene.looks(5)
    assert scene.looks(2)


def test_one_that_has_not_begun_ends_with_its_proxy(scene):
    """Its proxy is ended when the pool is: then nobody would end a manager that comes later."""
    told = disk.read_json(scene.paths.manager_start)
    told |= {"command": [sys.executable, "-c", "import signal; signal.pause()"]}
    disk.write_json(scene.paths.manager_start, told)
    assert scene.looks(2)
    with disk.locked(scene.paths.manager_lock):
        scene.restart.close()
        assert scene.restart.child.poll() is None
    scene.restart.close()
    assert scene.restart.child.poll() is not None


def test_one_that_ended_well_or_has_systemd_is_let_be(scene):
    proxy_supervisor.allow_restart(scene.paths, {"NOTIFY_SOCKET": "/run/systemd/notify"})
    assert not scene.looks(5)
    scene.paths.manager_start.write_text("[]")
    with pytest.raises(StateError, match="damaged"):
        scene.looks(1)


HOLDS = "import sys, time\nfrom pathlib import Path\nfrom fogft import disk\n"
HOLDS += "disk.Lock(Path(sys.argv[1])).acquire(wait=True)\nprint('held', flush=True)\n"
HOLDS += "while True: time.sleep(0.01)"


def test_one_that_hangs_is_killed_and_started_again(scene):
    """It holds its lock, so that no other manager can begin, and does nothing."""
    words = [sys.executable, "-c", HOLDS, str(scene.paths.manager_lock)]
    hangs = subprocess.Popen(words, stdout=subprocess.PIPE)
    try:
        hangs.stdout.readline()
        os.kill(hangs.pid, signal.SIGSTOP)
        os.waitpid(hangs.pid, os.WUNTRACED)  # until then it may come round once more
        assert not scene.looks(round(HANGS_AFTER_S / LOOK_S))
        assert hangs.poll() is None
        started = scene.looks(3)
        assert hangs.wait(20) == -signal.SIGKILL
    finally:
        hangs.kill()
        hangs.communicate()
    assert started or scene.looks(5)  # the kernel may have freed the lock between two looks
    assert scene.restart.child.wait(20) == 0
