"""Move a pool to another machine: CA, history, spec and intent in one sealed file.

docs/design/manager.md says what keeps the old machine, or another copy, from managing it too.

Owns: what is in the file, and the order of steps. Not here: sealing (`bundle`).
"""

import contextlib
import functools
import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from fogft import disk
from fogft.errors import FogftError, PoolBusy, PoolNotFound
from fogft.model.credentials import manager_of
from fogft.model.plain import Count, stored, to_plain
from fogft.pool.commands import joining, startup
from fogft.pool.commands.composition import make_store
from fogft.pool.credentials import bundle
from fogft.pool.credentials.bundle import Label
from fogft.pool.folder import costs, lease
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import Identity, PoolStore, read_identity, write_identity
from fogft.pool.manager import proxy_supervisor, shutdown

_POOL, _CLOUD, _COSTS = "pool", "cloud", "costs"  # folders in the file
_check_name = functools.partial(joining.check_name, depth=4)


@dataclass(frozen=True)
class _Moved:
    identity: Identity
    files: Mapping[Annotated[str, _check_name], str]
    epoch: Count = 0


def export(
    store: PoolStore,
    root: Path,
    file: Path,
    passphrase: str,
    now: float,
    *,
    open_for_s: float,
    told: Callable[[str], None] = lambda _: None,
) -> Identity:
    """Seal a pool into a file and stop managing it here; return its identity.

    This machine's client proxy keeps running, so that requests are answered meanwhile; if a service
    is stateful, the proxy ends, since only one robot may order its requests.

    If the file exists or cannot be written, this machine continues to manage the pool.
    """
    bundle.check_passphrase(passphrase)
    if file.exists():
        raise FogftError(f"`{file}` exists", "choose another name")
    if not os.access(file.parent, os.W_OK | os.X_OK):
        raise FogftError(f"`{file.parent}` is no folder to write to", "choose another")
    unfinished = file.with_name(f"{file.name}.unfinished")
    paths = store.paths
    with disk.locked(paths.intent_lock):
        identity = store.identity()
        try:
            with contextlib.ExitStack() as ended:
                ended.enter_context(shutdown.without_manager(paths, told))
                store.identity()  # the manager may have stepped back just now
                proxy_supervisor.forbid_restart(paths)
                ended.enter_context(shutdown.without_orders(paths, store.spec(), told))
                name, until = manager_of(identity.uid).common_name, now + open_for_s
                label = Label(secrets.token_hex(16), identity.name, name, now, until)
                files = dict(_files(paths, identity, root))
                moved = _Moved(identity, files, lease.read_epoch(paths))
                disk.write_whole(unfinished, bundle.seal(label, to_plain(moved), passphrase))
                os.replace(paths.identity, paths.exported)
        except BaseException as error:
            if paths.identity.exists():  # else the file is all that is left
                with contextlib.suppress(OSError):
                    unfinished.unlink()
                startup.start_manager(store)
            if isinstance(error, OSError):
                raise FogftError(f"`{error.filename}` is needed: {error.strerror}") from None
            raise
        try:
            os.replace(unfinished, file)
        except OSError as error:
            raise FogftError(
                f"`{unfinished}` cannot be renamed: {error.strerror}",
                "it contains the exported pool: use it as it is",
            ) from None
    return identity


def _files(paths: PoolPaths, identity: Identity, root: Path) -> Iterator[tuple[str, str]]:
    """Yield the name and content of each file that another machine needs; bytes as Latin-1."""
    kept = (
        *(paths.spec, paths.good_spec, paths.intent, paths.trial, paths.discovered, paths.gateway),
        *(paths.history, paths.membership, paths.records, paths.manager_records),
        paths.announcements,
        *sorted(paths.credentials.iterdir()),
        *sorted(paths.proxy_status.with_suffix(".marks").glob("*")),
    )
    for path in kept:
        if path.is_file() and path.suffix != ".lock":
            yield f"{_POOL}/{path.relative_to(paths.folder)}", path.read_bytes().decode("latin-1")
    spent = costs.path_of(paths.costs, identity.name, identity.uid)
    if spent.exists():
        yield f"{_COSTS}/{spent.name}", spent.read_bytes().decode("latin-1")
    for path in sorted((root / identity.cloud / "launches").rglob("*")):
        if identity.uid in str(path) and path.suffix != ".log" and path.is_file():
            name = path.relative_to(root / identity.cloud)
            yield f"{_CLOUD}/{name}", path.read_bytes().decode("latin-1")


def import_(
    file: Path, passphrase: str, root: Path, now: float, *, pool_file: Path | None = None
) -> PoolStore:
    """Take over a pool from its file; return it, still without a manager.

    `pool_file` is the pool file on this machine; relative paths in it start at its folder.
    """
    label, content = bundle.open_sealed(joining.read(file), passphrase, now)
    brought = stored(_Moved, content, "the file contains no pool")
    was = brought.identity
    place = (pool_file or Path(was.file)).resolve()
    if not place.is_file():
        raise FogftError(
            f"the pool file `{place}` is not on this machine",
            "put it there with its `workdir`, or give its path with `--pool-file`",
        )
    paths = PoolPaths.of(was.name, root)
    disk.make_folder(paths.folder)
    with disk.locked(paths.intent_lock), joining.used_once(root, label):
        try:
            read_identity(paths)
        except PoolNotFound:
            pass
        except PoolBusy:  # exported from here
            ours = disk.read_as(Identity, paths.exported)
            if ours is None or ours.uid != was.uid:
                raise
        else:
            raise FogftError(
                f"this machine has a pool `{was.name}`",
                f"`fogft up` manages it, and `fogft down {was.name}` shuts it down",
            )
        shutil.rmtree(paths.credentials, ignore_errors=True)
        folders = {_POOL: paths.folder, _COSTS: paths.costs, _CLOUD: root / was.cloud}
        for name, text in brought.files.items():
            folder, _, rest = name.partition("/")
            if folder in folders and rest:
                disk.make_folder((folders[folder] / rest).parent)
                disk.write_whole(folders[folder] / rest, text.encode("latin-1"))
        before = max(brought.epoch, label.holder.generation, lease.read_epoch(paths))
        here = replace(was, file=str(place), first_epoch=lease.next_term(before))
        paths.exported.unlink(missing_ok=True)  # with both there, `down` would ask no cloud
        write_identity(paths, here)
    return make_store(was.name)
