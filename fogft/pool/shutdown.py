"""What `down` does: end everything of a pool, whether or not its manager lives.

Manager first (it would repair what we end), then the client proxy, then every machine
that carries the pool's uid, then the folder. Stopped half-way, it can be run again.

Owns: the order, and the proof that nothing is left.
Not here: ending one machine (`fogft.cloud`).
"""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from fogft import disk
from fogft.cloud.port import Cloud
from fogft.core.errors import CloudError, FogftError, PoolNotFound, StateError
from fogft.core.intent import Intent
from fogft.core.model import Machine
from fogft.pool import lease, process_control, proxy_report
from fogft.pool.paths import PoolPaths
from fogft.pool.store import Identity, PoolStore

LIMIT_S = 600.0
ASK_AGAIN_S = 1.0


def end(
    store: PoolStore,
    cloud_of: Callable[[Identity], Cloud],
    *,
    told: Callable[[str], None] = lambda _: None,
    limit_s: float = LIMIT_S,
) -> list[str]:
    """End a pool and return what was ended, in words, in order.

    Args:
        store: The pool.
        cloud_of: Returns the cloud that a pool runs on.
        told: Called with each thing as it has been ended.
        limit_s: How long machines may take to go.

    Raises:
        PoolNotFound: There is no such pool (any more).
        CloudUnreachable: It cannot be told what is left; run it again.
        FogftError: Something did not end (the message says what); run it again.
    """
    paths, identity = store.paths, store.identity()
    ended: list[str] = []

    def done(what: str) -> None:
        ended.append(what)
        told(what)

    with disk.locked(paths.intent_lock):
        try:
            identity = store.identity()
        except PoolNotFound:
            return ended  # another `down` was faster
        _end_process(done, "manager", paths.manager_lock, lease.read_pid(paths))
        # Should this be cut short, whoever manages the pool next goes on ending it.
        with contextlib.suppress(StateError):  # a full disk is no reason to keep paying
            store.write_intent(replace(_intent(store), stopping=True))
        end_client_proxy(paths, identity.uid, done)
        _end_machines(cloud_of(identity), identity.uid, done, limit_s)
        # The identity first: from here on there is no such pool.
        paths.identity.unlink(missing_ok=True)
        shutil.rmtree(paths.folder, ignore_errors=True)
    return ended


def end_client_proxy(paths: PoolPaths, uid: str, done: Callable[[str], None]) -> None:
    """End a pool's client proxy; tell it if there was one. Repeatable.

    Raises:
        FogftError: It does not end.
    """
    report = proxy_report.read(paths.proxy_status, uid)
    pid = report.pid if report is not None else None
    _end_process(done, "client proxy", paths.proxy_lock, pid)


def _intent(store: PoolStore) -> Intent:
    try:
        return store.intent()
    except StateError:
        return Intent()


def _end_process(
    done: Callable[[str], None], what: str, lock: Path, suspected_pid: int | None
) -> None:
    pid = process_control.end_holder(lock, suspected_pid=suspected_pid)
    if disk.is_locked(lock):
        raise FogftError(
            f"the {what} of `{lock.parent.name}` does not end",
            "it belongs to another user, or hangs in the kernel; end it and run `fogft down` again",
        )
    if pid is not None:
        done(f"{what} (pid {pid})")


def _end_machines(cloud: Cloud, uid: str, done: Callable[[str], None], limit_s: float) -> None:
    deadline = time.monotonic() + limit_s
    told: set[str] = set()
    errors: dict[str, str] = {}
    while True:
        left = [m for m in cloud.machines(uid) if m.id.pool_uid == uid]
        if not left:
            return
        if time.monotonic() > deadline:
            names = ", ".join(f"`{m.id.short}` ({m.placement.location})" for m in left)
            why = "; ".join(sorted(set(errors.values())))
            raise FogftError(
                f"these replicas did not end: {names}" + (f": {why}" if why else ""),
                "run `fogft down` again",
            )

        def terminate(machine: Machine) -> tuple[Machine, str]:
            try:
                cloud.terminate(machine.id)
            except CloudError as refused:
                return machine, refused.message
            return machine, ""

        with ThreadPoolExecutor(max_workers=8) as threads:
            for machine, error in threads.map(terminate, left):
                short = machine.id.short
                errors[short] = error
                if not error and short not in told:
                    told.add(short)
                    done(f"replica {short} ({machine.placement.location})")
        if any(errors[m.id.short] for m in left):
            time.sleep(ASK_AGAIN_S)
