"""`down` ends everything of a pool and nothing else, in whatever state the pool is."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from fogft import disk
from fogft.cloud.port import Launch
from fogft.errors import CloudUnreachable, FogftError, PoolNotFound, SpecError
from fogft.model.replica import ReplicaId
from fogft.pool.manager import shutdown
from tests.fakes.threads import no_more
from tests.pool.folder_cloud import ZONES
from tests.pool.scene import Scene

STRANGER = ReplicaId("f" * 16, 0, 1)


def test_down_ends_all_and_leaves_the_stranger(scene: Scene) -> None:
    """Manager, proxy, machines and folder go; another pool's machine stays."""
    scene.cloud.launch(Launch(STRANGER, "other", ZONES[0], 0.1, ""))
    scene.write(replicas=2)
    manager = scene.start_manager()
    scene.wait(lambda: scene.whole(2))
    uid = scene.store.identity().uid
    told = scene.end()
    assert manager.wait(10) == 0
    assert [line.split(" ")[0] for line in told] == ["manager", "client", "replica", "replica"]
    assert not scene.cloud.machines(uid)
    assert [m.id for m in scene.cloud.machines(STRANGER.pool_uid)] == [STRANGER]
    assert not scene.paths.folder.exists()
    with pytest.raises(PoolNotFound):
        scene.end()


def test_down_works_when_the_manager_is_dead_or_frozen(scene: Scene) -> None:
    """Neither a dead nor a stopped manager keeps a pool alive, even if no thread can be started."""
    scene.write(replicas=2)
    scene.start_manager()
    scene.wait(lambda: scene.whole(2))
    frozen = scene.started[0]
    frozen.send_signal(signal.SIGSTOP)
    with no_more():
        told = scene.end()
    frozen.wait(10)
    assert {"replica 0.1", "replica 1.1"} <= {what.partition(" (")[0] for what in told}
    assert not scene.paths.folder.exists()


def test_down_without_manager_or_proxy(scene: Scene) -> None:
    """A pool that was written and never started is ended too."""
    scene.write()
    assert scene.end() == []
    assert not scene.paths.folder.exists()


def test_down_ends_what_the_list_forgot(scene: Scene) -> None:
    """The clouds are asked past every memory before "nothing is left" is said."""
    scene.write(replicas=2)
    manager = scene.start_manager()
    scene.wait(lambda: scene.whole(2))
    manager.terminate()
    manager.wait(20)
    uid = scene.store.identity().uid
    scene.cloud.forget(ReplicaId(uid, 1, 1))
    warned: list[str] = []
    told = scene.end(warned)
    assert [what for what in told if what.startswith("replica")] == [
        "replica 0.1 (folder/one/a)",
        "replica 1.1 (folder/three/a)",
    ]
    assert not scene.cloud.audit().machines
    assert warned == []


def test_down_says_which_cloud_could_not_be_asked(scene: Scene) -> None:
    """Its own list could not be had: whose word it is then, and how to look for oneself."""
    scene.write(replicas=1)
    scene.start_manager()
    scene.wait(lambda: scene.whole(1))
    uid = scene.store.identity().uid
    (scene.cloud.folder / "mute").touch()
    warned: list[str] = []
    scene.end(warned)
    [warning] = warned
    assert warning.startswith("`folder` could not be queried")
    assert f"`fogft-pool={uid}`" in warning


def test_down_that_gets_no_answer_lists_what_may_still_run(scene: Scene) -> None:
    """Which replicas, where, how to look, and when they end by themselves."""
    scene.write(replicas=2)
    scene.start_manager()
    scene.wait(lambda: scene.whole(2))
    (scene.cloud.folder / "outage").touch()
    with pytest.raises(CloudUnreachable) as caught:
        scene.end()
    lines = caught.value.message.splitlines()
    assert lines[0] == "cannot tell what is left of `pool`: told to be"
    assert [line.strip() for line in lines[1:]] == [
        "may still be running: replica 0.1 (folder/one/a)",
        "may still be running: replica 1.1 (folder/three/a)",
    ]
    assert caught.value.hint == (
        "run `fogft down pool` again; replicas that hear from no manager shut down after 24 hours"
    )


def test_down_that_is_refused_says_by_whom_and_why(scene: Scene) -> None:
    scene.write(replicas=1)
    scene.start_manager()
    scene.wait(lambda: scene.whole(1))
    keeping = scene.cloud.keep("0.1")
    with pytest.raises(FogftError) as caught:
        shutdown.end(scene.store, lambda _: scene.cloud, limit_s=0)
    assert caught.value.message == (
        "these replicas did not end: `0.1` (folder/one/a): told to keep it"
    )
    keeping.unlink()
    assert scene.end() == ["replica 0.1 (folder/one/a)"]


def test_down_can_be_repeated_after_an_outage(scene: Scene) -> None:
    """While the cloud cannot tell, the pool's files stay, so that the next try finds all."""
    scene.write(replicas=1)
    scene.start_manager()
    scene.wait(lambda: scene.whole(1))
    (scene.cloud.folder / "outage").touch()
    with pytest.raises(CloudUnreachable):
        scene.end()
    assert scene.store.intent().stopping
    assert not disk.is_locked(scene.paths.manager_lock)
    (scene.cloud.folder / "outage").unlink()
    assert scene.end() == ["replica 0.1 (folder/one/a)"]


def test_of_two_at_once_one_ends_the_pool_and_neither_complains(scene: Scene) -> None:
    """The slower one finds nothing left to do."""
    scene.write(replicas=2)
    scene.start_manager()
    scene.wait(lambda: scene.whole(2))
    inode = scene.paths.intent_lock.stat().st_ino

    def waiting() -> int:
        lines = Path("/proc/locks").read_text().splitlines()
        return sum("->" in line and f":{inode} " in line for line in lines)

    with ThreadPoolExecutor(2) as threads:
        with disk.locked(scene.paths.intent_lock):
            downs = [threads.submit(scene.end) for _ in range(2)]
            scene.wait(lambda: waiting() == 2)
        ended = sorted(len(down.result()) for down in downs)
    assert ended[0] == 0
    assert ended[1] >= 3


def test_a_damaged_specification_neither_stops_its_repair_nor_the_end(scene: Scene) -> None:
    """What a bad disk leaves is one clear error; `up` writes it anew and `down` needs none."""
    scene.write(replicas=1)
    scene.paths.spec.write_bytes(b"\xff\xfe\x00 not text")
    with pytest.raises(SpecError, match="is damaged") as caught:
        scene.store.spec()
    assert "fogft down" in caught.value.hint
    scene.write(replicas=1)
    assert scene.store.spec().replicas == 1
    scene.paths.spec.write_bytes(b"\xff\xfe\x00 not text")
    scene.end()
    assert not scene.paths.folder.exists()


TAKE = """
import sys
from pathlib import Path
from fogft import disk

lock = disk.Lock(Path(sys.argv[1]))
print("waits", flush=True)
lock.acquire(wait=True)
if Path(sys.argv[1]).exists():  # as a standby looks: no folder, no work
    sys.stdin.read()
"""


def test_a_standby_that_is_only_starting_is_ended_too(scene: Scene) -> None:
    """It holds no place in line yet, and may take the work over while `down` ends the proxy."""
    scene.write()
    line = [
        subprocess.Popen(
            [sys.executable, "-c", TAKE, str(scene.paths.proxy_lock)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )
        for _ in range(2)
    ]  # fmt: skip
    try:
        for one in line:
            assert one.stdout is not None
            assert one.stdout.readline() == "waits\n"
        scene.wait(lambda: disk.is_locked(scene.paths.proxy_lock))
        told = scene.end()
        codes = {one.pid: one.wait(30) for one in line}
        assert set(codes.values()) <= {-signal.SIGTERM, 0}
        ended = [pid for pid, code in codes.items() if code]
        assert sorted(told) == sorted(f"client proxy (pid {pid})" for pid in ended)
        assert ended
    finally:
        for one in line:
            one.kill()
            one.communicate()


HAND_OVER = """
import signal, sys, time
from pathlib import Path
from fogft import disk

def told(number, frame):
    print("standby" if disk.is_locked(Path(sys.argv[2])) else "nobody", flush=True)
    sys.exit(0)

signal.signal(signal.SIGTERM, told)
lock = disk.Lock(Path(sys.argv[1]))
lock.acquire(wait=True)
print("works", flush=True)
while True:
    time.sleep(0.1)
"""


@pytest.mark.parametrize("stands_by", [False, True])
def test_a_proxy_that_is_ended_finds_nobody_to_hand_over_to(scene: Scene, stands_by: bool) -> None:
    """Else it would wait for its successor, and be killed."""
    scene.write()
    works, waits = scene.paths.proxy_lock, scene.paths.standby_lock
    places = [(waits, works)] if stands_by else []
    line = [
        subprocess.Popen(
            [sys.executable, "-c", HAND_OVER, *place], stdout=subprocess.PIPE, text=True
        )
        for place in [*places, (works, waits)]
    ]
    try:
        for one in line:
            assert one.stdout is not None
            assert one.stdout.readline() == "works\n"
        proxy = line[-1]
        assert scene.end() == [f"client proxy (pid {proxy.pid})"]
        assert proxy.stdout is not None
        assert proxy.stdout.readline() == "nobody\n"
    finally:
        for one in line:
            one.kill()
            one.communicate()


def test_no_client_proxy_can_take_a_place_in_line_meanwhile(scene: Scene) -> None:
    scene.write()
    line = scene.paths.proxy_lock, scene.paths.standby_lock, scene.paths.spare_lock
    with shutdown.without_client_proxy(scene.paths, print):
        assert all(map(disk.is_locked, line))
    assert not any(map(disk.is_locked, line))


WRITE = """
import itertools, sys
from pathlib import Path
from fogft import disk

lock = disk.Lock(Path(sys.argv[1]))
lock.acquire(wait=True)
for number in itertools.count():
    path = Path(sys.argv[1]).parent / f"file.{number % 100}"
    try:
        path.touch()
    except OSError:  # no folder
        break
    if number == 100:
        print("writes", flush=True)
"""


def test_a_manager_that_has_just_stepped_back_leaves_no_file(scene: Scene) -> None:
    """It finds that another machine manages the pool, and still writes as it ends."""
    scene.write()
    scene.paths.identity.rename(scene.paths.exported)
    manager = subprocess.Popen(
        [sys.executable, "-c", WRITE, scene.paths.manager_lock], stdout=subprocess.PIPE, text=True
    )
    try:
        assert manager.stdout is not None
        assert manager.stdout.readline() == "writes\n"
        assert scene.end() == [f"manager (pid {manager.pid})"]
        assert not scene.paths.folder.exists()
        assert manager.wait(30) == -signal.SIGTERM
    finally:
        manager.kill()
        manager.communicate()


def test_files_that_stay_are_told(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """There may be keys among them."""
    scene.write()
    monkeypatch.setattr(shutdown.shutil, "rmtree", lambda *_, **__: None)
    with pytest.raises(FogftError, match="cannot be removed"):
        scene.end()


def test_a_down_that_is_killed_leaves_no_key_of_a_pool_that_is_not_listed(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene.write()
    assert list(scene.paths.credentials.glob("*.key"))

    rmtree = shutil.rmtree

    def killed(folder: Path, **options: bool) -> None:
        if folder == scene.paths.folder:
            raise KeyboardInterrupt
        rmtree(folder, **options)

    monkeypatch.setattr(shutdown.shutil, "rmtree", killed)
    with pytest.raises(KeyboardInterrupt):
        scene.end()
    assert not scene.paths.identity.exists()
    assert not scene.paths.credentials.exists()
