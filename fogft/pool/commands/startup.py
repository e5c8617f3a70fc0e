"""``fogft up``: create or change the pool's folder, and start its manager.

The identity is written after everything else, and a pool exists once it is there: so an interrupted
`up` that creates a pool has no effect.

Not here: judging the file (`preview`), waiting for the services (`fogft.cli.progress`).
"""

import secrets
import shutil
import time
from pathlib import Path

from fogft import __version__, disk, logfile
from fogft.child import detached, python
from fogft.errors import FogftError, PoolBusy, PoolNotFound
from fogft.model import intent
from fogft.model.intent import Intent
from fogft.model.spec import PoolSpec
from fogft.planning import lifetime
from fogft.pool.commands.composition import make_store
from fogft.pool.commands.preview import Preview, check_same
from fogft.pool.credentials import authority
from fogft.pool.folder.paths import PoolPaths, home
from fogft.pool.folder.store import Identity, PoolStore, read_identity, write_identity
from fogft.pool.manager import process_control, proxy_supervisor, shutdown
from fogft.pool.manager.proxy_supervisor import ProxySupervisor

MANAGER_LIMIT_S = 20.0


def start(order: Preview) -> bool:
    """Create the pool or apply the changed file; return whether a manager had to be started."""
    disk.make_folder(home())
    store, cloud = make_store(order.spec.name), order.cloud
    write(store, order.spec, source=order.source, file=order.file.resolve(), cloud=cloud)
    revive_client_proxy(store.paths)
    return start_manager(store)


def write(store: PoolStore, spec: PoolSpec, *, source: str, file: Path, cloud: str) -> None:
    """Create a pool, or apply a changed file to it."""
    paths = store.paths
    disk.make_folder(paths.folder)
    with disk.locked(paths.intent_lock):
        if not paths.intent_lock.exists():
            raise PoolBusy(f"pool `{spec.name}` has just been shut down", "run `fogft up` again")
        try:
            identity = read_identity(paths)
        except PoolNotFound:
            _create(store, spec, source, file, cloud)
            return
        check_same(identity, spec, file, cloud)
        try:
            before, old_source = store.spec(), paths.spec.read_text()
        except FogftError:  # written by a version that knew other keys
            before, old_source = spec, ""
        after = intent.file_changed(store.intent(), before, spec)
        begun_at = lifetime.begun_at(after, identity.created_at, store.history())
        # The file first: the old file with the new intent would lose its `scale`.
        if old_source != source:
            disk.write_whole(paths.spec, source)
        store.write_intent(lifetime.revived(before, after, begun_at, time.time()))


def _create(store: PoolStore, spec: PoolSpec, source: str, file: Path, cloud: str) -> None:
    paths = store.paths
    # An interrupted `up`, or a pool whose identity was lost, may have left a client proxy, whose
    # reports are not about this pool.
    proxy_supervisor.forbid_restart(paths)
    ended: list[str] = []
    with (
        shutdown.without_manager(paths, ended.append),
        shutdown.without_client_proxy(paths, ended.append),
    ):
        uid = secrets.token_hex(8)
        old = (
            *(paths.history, paths.membership, paths.lease, paths.records, paths.manager_records),
            *(paths.good_spec, paths.trial, paths.discovered, paths.status, paths.proxy_status),
        )
        for left in (paths.credentials, *old):
            if left.is_dir() and not left.is_symlink():
                shutil.rmtree(left, ignore_errors=True)
            else:
                left.unlink(missing_ok=True)
        authority.create_authority(paths.credentials, uid)
        disk.write_whole(paths.spec, source)
        store.write_intent(Intent())
        write_identity(paths, Identity(spec.name, uid, cloud, str(file), time.time()))


def revive_client_proxy(paths: PoolPaths) -> None:
    """Start the client proxy if the manager was killed: it serves without one, and sooner."""
    killed = paths.manager_start.exists() and not disk.is_locked(paths.manager_lock)
    if killed and paths.proxy_config.exists():
        ProxySupervisor(paths, time.monotonic).look()


def manager_version(paths: PoolPaths, pid: int | None = None) -> str:
    """Return the fogft version of a pool's manager, if it is process `pid`; empty if unknown."""
    said = disk.read_json(paths.status)
    if not isinstance(said, dict) or (pid is not None and said.get("manager_pid", pid) != pid):
        return ""
    return str(said.get("manager_version", "before 0.2.0"))


def start_manager(store: PoolStore) -> bool:
    """Ensure that the pool has a manager of this version; return whether one was started.

    The version of a manager that has just started is awaited first: another `up` that ended the
    same old manager may have started it.
    """
    paths = store.paths
    name = paths.folder.name
    child = None
    end = time.monotonic() + MANAGER_LIMIT_S
    while time.monotonic() < end:
        pid = disk.holder(paths.manager_lock)
        if child is not None and pid == child.pid:
            return True
        if pid is not None:
            version = manager_version(paths, pid)
            if version == __version__:
                return False
            if version:
                process_control.end_holder(paths.manager_lock, only=pid)
                continue
        elif child is None:
            child = detached(python("-m", "fogft", "manager", name), paths.manager_log)
        elif child.poll() is not None:
            break
        time.sleep(process_control.POLL_S)
    if disk.is_locked(paths.manager_lock):  # it cannot write its status: `status` says why
        return False
    raise FogftError(
        f"the manager of `{name}` did not start:\n{logfile.tail(paths.manager_log)}",
        f"see `{paths.manager_log}`, and run `fogft doctor`",
    )
