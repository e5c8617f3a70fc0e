"""``fogft down``: end everything of a pool, with or without its manager.

The manager ends first (it would repair what we end), then the client proxy, the machines and the
folder. If interrupted, `down` can be run again. It takes each lock from the process that it ends,
and keeps it: a process that is just starting finds the lock taken and exits.

Not here: ending the machines, and verifying that none is left (`teardown`).
"""

import contextlib
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from fogft import disk
from fogft.cloud.port import Cloud
from fogft.errors import FogftError, PoolNotFound, StateError
from fogft.model.intent import Intent
from fogft.model.spec import PoolSpec
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import Identity, PoolStore
from fogft.pool.manager import process_control, teardown

LIMIT_S = 600.0
_TRIES = 4  # processes that may wait for a lock: a standby, and one by each of its starters


def end(
    store: PoolStore,
    cloud_of: Callable[[Identity], Cloud],
    *,
    told: Callable[[str], None] = lambda _: None,
    warned: Callable[[str], None] = lambda _: None,
    limit_s: float = LIMIT_S,
) -> None:
    """Shut a pool down; of a pool that another machine manages, only what is left here.

    `told` is called with each thing that has ended, `warned` with what could not be verified.

    Raises:
        PoolNotFound: There is no such pool (any more).
        CloudUnreachable: It is not known what is left; call this again.
        FogftError: Something did not end (the message says what); call this again.
    """
    paths = store.paths
    if paths.exported.exists():
        _end_exported(paths, told)
        return
    store.identity()
    with disk.locked(paths.intent_lock), contextlib.ExitStack() as kept:
        try:
            identity = store.identity()
        except PoolNotFound:
            return  # another `down` was faster
        kept.enter_context(without_manager(paths, told))
        store.identity()  # the manager may have stepped back just now
        # If this is interrupted, the next manager of the pool continues to end it.
        with contextlib.suppress(StateError):  # a full disk is no reason to keep paying
            before = disk.read_or(paths.intent, Intent())
            store.write_intent(replace(before, stopping=True))
        kept.enter_context(without_client_proxy(paths, told))
        teardown.end_machines(
            cloud_of(identity),
            identity.uid,
            known=teardown.known(store),
            done=told,
            warned=warned,
            limit_s=limit_s,
        )
        shutil.rmtree(paths.credentials, ignore_errors=True)
        # The identity before the rest: from here on there is no such pool.
        with contextlib.suppress(OSError):  # it is not a file
            paths.identity.unlink()
        _remove(paths.folder)


def _end_exported(paths: PoolPaths, told: Callable[[str], None]) -> None:
    with disk.locked(paths.intent_lock):
        if not paths.exported.exists():
            return  # another `down` was faster, or it was imported again
        # A manager that has just stepped back may still be running, and writing.
        with without_manager(paths, told), without_client_proxy(paths, told):
            _remove(paths.folder)


def _remove(folder: Path) -> None:
    for _ in range(_TRIES):  # a command may be writing to it
        shutil.rmtree(folder, ignore_errors=True)
    if folder.exists():
        raise FogftError(f"`{folder}` cannot be removed", "remove it yourself")


def without_manager(
    paths: PoolPaths, done: Callable[[str], None]
) -> contextlib.AbstractContextManager[None]:
    """End a pool's manager; none can start inside this context."""
    return _taken(done, "manager", paths.manager_lock)


@contextlib.contextmanager
def without_client_proxy(paths: PoolPaths, done: Callable[[str], None]) -> Iterator[None]:
    """End a pool's client proxies; none can start inside this context."""
    with contextlib.ExitStack() as kept:
        kept.enter_context(_taken(lambda _: None, "spare client proxy", paths.spare_lock))
        # Leave the standby's lock free until the proxy is gone: it would wait for us to take over.
        process_control.end_holder(paths.standby_lock)
        kept.enter_context(_taken(done, "client proxy", paths.proxy_lock))
        kept.enter_context(_taken(lambda _: None, "standby client proxy", paths.standby_lock))
        yield


def without_orders(
    paths: PoolPaths, spec: PoolSpec, done: Callable[[str], None]
) -> contextlib.AbstractContextManager[None]:
    """Like `without_client_proxy`, if a service is stateful: only one robot may order requests."""
    is_stateful = any(service.state is not None for service in spec.services)
    return without_client_proxy(paths, done) if is_stateful else contextlib.nullcontext()


@contextlib.contextmanager
def _taken(done: Callable[[str], None], what: str, path: Path) -> Iterator[None]:
    """Hold a lock; end the process that holds it, and any that takes it before us."""
    lock = disk.Lock(path)
    for _ in range(_TRIES):
        pid = process_control.end_holder(path)
        if pid is not None and disk.holder(path) != pid:
            done(f"{what} (pid {pid})")
        if lock.acquire(wait=False):
            break
    else:
        raise FogftError(
            f"the {what} of `{path.parent.name}` does not exit",
            "it belongs to another user, or hangs in the kernel; end "
            "it, then run `fogft down` again",
        )
    try:
        yield
    finally:
        lock.release()
