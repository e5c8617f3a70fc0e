"""`up` on disk: new, changed, somebody else's, or cut short."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

from fogft import disk
from fogft.errors import PoolNotFound, SpecError
from fogft.model import intent as intents
from fogft.model.names import POOL_UID_PATTERN
from fogft.pool.commands import startup
from fogft.pool.credentials import authority
from fogft.pool.manager import proxy_supervisor
from fogft.poolfile import file
from tests.pool.scene import Scene


def test_a_new_pool_has_all_it_needs_and_is_private(scene: Scene) -> None:
    """Identity, file, intent and CA, in a folder that only its user can enter."""
    identity = scene.write()
    assert POOL_UID_PATTERN.fullmatch(identity.uid)
    assert scene.paths.folder.stat().st_mode & 0o777 == 0o700
    assert scene.paths.spec.read_text() == scene.file.read_text()
    for path in (scene.paths.identity, scene.paths.spec, scene.paths.credentials / "ca.key"):
        assert path.stat().st_mode & 0o777 == 0o600
    name = authority.describe(scene.paths.credentials / "ca.crt").common_name
    assert name == f"fogft.{identity.uid}"


def test_the_same_file_again_changes_nothing(scene: Scene) -> None:
    """`up` is repeatable: same uid, same CA."""
    first = scene.write()
    ca = (scene.paths.credentials / "ca.crt").read_bytes()
    spec = disk.version(scene.paths.spec)
    assert scene.write() == first
    assert disk.version(scene.paths.spec) == spec
    assert (scene.paths.credentials / "ca.crt").read_bytes() == ca


def test_a_changed_file_is_applied_and_keeps_the_scale(scene: Scene) -> None:
    """A change elsewhere keeps `scale`; the file's own `replicas` ends it."""
    scene.write(replicas=2)
    store = scene.store
    store.write_intent(intents.scale(store.intent(), store.spec(), 1, 0.0))
    scene.write(replicas=2, timeout_s=9.0)
    assert store.spec().services[0].timeout_s == 9.0
    assert store.intent().wanted(store.spec(), 0.0) == 3
    scene.write(replicas=4)
    assert store.intent().wanted(store.spec(), 0.0) == 4


def test_a_changed_file_never_looks_to_a_manager_as_if_scale_was_forgotten(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It looks at each file that changes: the old file alone would have it end three replicas."""
    scene.write(replicas=2)
    store, write, seen = scene.store, disk.write_whole, set[int]()
    store.write_intent(intents.scale(store.intent(), store.spec(), 3, 0.0))

    def written(*given: Any, **how: Any) -> None:
        write(*given, **how)
        seen.add(store.intent().wanted(store.spec(), 0.0))

    monkeypatch.setattr(disk, "write_whole", written)
    scene.write(replicas=6)
    assert seen <= {5, 6}
    assert store.intent().wanted(store.spec(), 0.0) == 6


def test_the_same_name_from_another_file_is_refused(scene: Scene) -> None:
    """Two projects that call their pool alike do not change each other's."""
    scene.write()
    other = scene.home / "other.yaml"
    other.write_text(scene.file.read_text().replace("replicas: 2", "replicas: 3"))
    with pytest.raises(SpecError, match="was started from") as caught:
        startup.write(
            scene.store,
            file.read(other),
            source=other.read_text(),
            file=other,
            cloud="folder",
        )
    assert "put that file back if it was moved" in caught.value.hint
    assert "fogft down pool" in caught.value.hint
    assert scene.store.spec().replicas == 2


def test_another_cloud_is_refused(scene: Scene) -> None:
    """A pool does not move between clouds under its machines' feet."""
    scene.write()
    with pytest.raises(SpecError, match="runs on cloud `folder`"):
        startup.write(
            scene.store,
            file.read(scene.file),
            source=scene.file.read_text(),
            file=scene.file,
            cloud="sky",
        )


def test_an_up_cut_short_is_an_up_that_never_was(scene: Scene) -> None:
    """Without the identity there is no pool, and the next `up` starts over with a new CA."""
    first = scene.write()
    scene.paths.identity.unlink()
    scene.paths.history.write_text('{"at": 1, "kind": "launch", "slot": 0, "generation": 7}\n')
    with pytest.raises(PoolNotFound):
        scene.store.identity()
    second = scene.write()
    assert second.uid != first.uid
    name = authority.describe(scene.paths.credentials / "ca.crt").common_name
    assert name == f"fogft.{second.uid}"
    assert not scene.paths.history.exists()


def test_the_client_proxy_of_a_pool_whose_identity_was_lost_tells_nothing_of_the_next(
    scene: Scene,
) -> None:
    """It would go on with the replicas that it has, and the new pool be called ready for them."""
    first = scene.write()
    paths = scene.paths
    held = "import signal,sys; from fogft import disk; disk.Lock(disk.Path(sys.argv[1])).acquire("
    program = held + "wait=False); print(flush=True); signal.pause()"
    with subprocess.Popen(
        [sys.executable, "-c", program, str(paths.proxy_lock)], stdout=subprocess.PIPE
    ) as old:
        assert old.stdout is not None
        old.stdout.readline()
        paths.proxy_status.write_text("{}")
        paths.history.mkdir()
        paths.identity.unlink()
        assert scene.write().uid != first.uid
        assert old.wait(20) != 0
    assert not paths.proxy_status.exists()
    assert scene.store.history().record(0, 1) is None


@pytest.mark.parametrize("killed", [True, False])
def test_where_the_manager_was_killed_its_client_proxy_does_not_wait_for_the_next_one(
    scene: Scene, killed: bool
) -> None:
    """One that was told to end has left word that nothing is to be started."""
    scene.write()
    scene.paths.proxy_config.write_text("")
    if killed:
        proxy_supervisor.allow_restart(scene.paths, {})
    startup.revive_client_proxy(scene.paths)
    log = scene.paths.proxy_log
    if killed:
        scene.wait(lambda: str(scene.paths.proxy_config) in log.read_text())
    assert log.exists() is killed
