"""The standby client proxy, and hand-over to it. Design: docs/design/manager.md.

The standby has loaded everything and its DDS participant is known, but it offers nothing and no
node of it is seen. It waits for the lock, which the kernel gives it when the holder ends. Behind it
a spare waits for its place, which has no thread of ROS's or Zenoh's yet, so that it can fork.
"""

import contextlib
import hashlib
import importlib
import logging
import os
import threading
import time
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from fogft import disk
from fogft.errors import PoolBusy, StateError
from fogft.model.names import REQUEST_ID_BYTES
from fogft.model.proxy_config import ClientProxyConfig
from fogft.process import Watchdog, notify, on_thread
from fogft.proxy import middleware
from fogft.proxy.robot.client import ClientProxy
from fogft.records.signing import Signer
from fogft.ros.joining import EarlyJoin, Pauses

log = logging.getLogger(__name__)

LOOK_S = 0.2
BEGIN_LIMIT_S = 15.0  # the standby offers our services by then, or it has failed
RENEWED_AFTER_S = 0.5  # a pause, a standby has joined anew and is known
COPIES = 10  # of copies, at most so many within a time: they may be ending by themselves
COPIES_WITHIN_S = 60.0
KNOWN_AFTER_S = 1.0  # once it offers them and knows the callers: until they know its services
ORDER_LIMIT_S = 20.0  # what was ordered is answered by then, or not at all
ANEW_LIMIT_S = 2.0  # without a standby: who asks now is answered only afterwards
FINISH_LIMIT_S = 130.0  # in all less than systemd and `fogft service install` wait
_PACED_S = 0.5  # until responses that are spread for their client are out
# What a client proxy imports only when it needs it.
_NEEDED = (
    "fogft.link.zenoh.robot.dialer",
    "fogft.proxy.robot.process",
    "fogft.ros.messages",
    "fogft.ros.node",
)


def wait(
    config: ClientProxyConfig, lock: disk.Lock, stop: threading.Event, node: str, *, spare: bool
) -> EarlyJoin | None:
    """Prepare as much as possible, then wait for the lock; return the prepared ROS node.

    Returns early, without the lock, when `stop` is set or the pool's folder is gone. A `spare`
    waits for the standby's place first.

    Raises:
        PoolBusy: Another one is next in line already.
        FogftError: ROS cannot be used.
    """
    for module in _NEEDED:
        importlib.import_module(module)
    Signer(config.credentials.certificate, config.credentials.key)  # loads `cryptography`
    place = disk.Lock(disk.standby_lock(config.lock))
    if spare:
        _wait_as_spare(config, place, stop)
    elif not place.acquire(wait=False):  # whoever holds it is ready to take over
        raise PoolBusy(f"the client proxy of pool `{config.pool}` already has a standby")
    if stop.is_set():
        return None
    middleware.load_types([service.type for service in config.services])
    early = middleware.join_early(config.rmw, node, config.domain_id)
    log.info("standby_ready pool=%s", config.pool)
    pauses = Pauses()

    def look() -> None:
        nonlocal early
        if early is not None and pauses.was_long():
            early.close()
            early = middleware.join_early(config.rmw, node, config.domain_id)
        if early is not None:
            early.look()

    if not _take(lock, config, stop, look) and early is not None:
        early.close()
    place.release()
    return early


def _wait_as_spare(config: ClientProxyConfig, place: disk.Lock, stop: threading.Event) -> None:
    """Wait for the standby's place; leave a copy of this process that waits for it in turn."""
    spare, copied = disk.Lock(disk.standby_lock(disk.standby_lock(config.lock))), list[float]()
    while True:
        if not spare.acquire(wait=False):
            raise PoolBusy(f"the standby of pool `{config.pool}` already has a spare")
        log.info("spare_ready pool=%s pid=%d", config.pool, os.getpid())
        taken = _take(place, config, stop)
        spare.release()
        copied = [at for at in copied if at > time.monotonic() - COPIES_WITHIN_S]
        # systemd counts only on what it has started.
        if not taken or len(copied) >= COPIES or "NOTIFY_SOCKET" in os.environ or os.fork():
            return
        copied.append(time.monotonic())
        place.release()  # the one that we are a copy of has it


def _take(
    lock: disk.Lock,
    config: ClientProxyConfig,
    stop: threading.Event,
    look: Callable[[], None] = lambda: None,
) -> bool:
    """Wait for a lock; return whether we have it, or are to stop."""

    def take() -> None:
        taken = False
        while not taken:
            try:
                taken = lock.acquire(wait=True)
            except OSError as error:  # no descriptor, or the folder is gone
                log.error("lock_failed reason=%r", str(error))
                time.sleep(LOOK_S)

    taking, watchdog = on_thread(take, name="standby"), Watchdog()
    notify("READY=1")
    while taking.is_alive() and not stop.is_set():
        taking.join(LOOK_S)
        watchdog.work()
        look()
        if not config.lock.parent.exists():
            stop.set()
    return not stop.is_set()


def request_ids(key: Path, identity: Callable[[Any], Any]) -> Callable[[str, Any], bytes]:
    """Return what gives requests their ids: both proxies of a robot give a request the same.

    Others cannot guess it: the robot's private `key` is part of it. `identity` returns what both
    know a request by, of its handle; without an id of ROS's own it gets a random one.
    """
    try:
        secret = hashlib.sha256(key.read_bytes()).digest()
    except OSError:  # who needs the key will say so
        secret = os.urandom(32)

    def id_of(service: str, handle: Any) -> bytes:
        if not isinstance(handle, bytes):
            return os.urandom(REQUEST_ID_BYTES)
        told = service.encode() + b"\0" + identity(handle)
        return hashlib.blake2b(told, key=secret, digest_size=REQUEST_ID_BYTES).digest()

    return id_of


def hand_over(
    config: ClientProxyConfig,
    proxy: ClientProxy,
    callers: Callable[[], Mapping[str, int]],
    release: Callable[[], None],
) -> bool:
    """Hand over to the standby; return, when done, whether there was one.

    `callers` counts who may call each service that we offer; `release` gives up the lock, and all
    else that the standby needs for itself. Replicas that dial in have one door: nothing is shared.
    Where the pool's folder goes, nothing more is waited for.
    """
    taken, order = _files(config.lock)
    lock = disk.Lock(order)
    try:
        if config.dial_in or not disk.is_locked(disk.standby_lock(config.lock)):
            return False
        taken.unlink(missing_ok=True)
        if not lock.acquire(wait=False):
            raise BlockingIOError("another one is handing over to this one")
    except (OSError, StateError) as error:
        log.error("handover_failed reason=%r", str(error))
        return False
    log.info("handover_began pool=%s", config.pool)

    def run(limit_s: float, done: Callable[[], bool]) -> bool:
        return _run(proxy, limit_s, lambda: done() or not config.lock.parent.exists())

    proxy.begin_hand_over()
    release()
    if run(BEGIN_LIMIT_S, lambda: _takes(config.status, callers())):
        run(KNOWN_AFTER_S, lambda: False)
    proxy.take_no_more()
    run(ORDER_LIMIT_S, lambda: proxy.waiting(ordered=True) == 0)
    told = {name: [id.hex() for id in ids] for name, ids in proxy.hold().items()}
    try:
        disk.write_json(taken, told, durable=False)
    except StateError as error:
        log.error("handover_failed reason=%r", error.message)
    lock.release()
    if run(FINISH_LIMIT_S, lambda: proxy.waiting() == 0):
        run(_PACED_S, lambda: False)
    log.info("handover_ended pool=%s", config.pool)
    return True


def start_anew(proxy: ClientProxy) -> None:
    """Answer what is under way, as far as that is soon, before this process starts anew."""
    proxy.take_no_more()
    _run(proxy, ANEW_LIMIT_S, lambda: proxy.waiting() == 0)


def is_held(lock: Path) -> bool:
    """Whether the proxy that hands over to us still orders stateful services."""
    return disk.is_locked(_files(lock)[1])


def taken_before(lock: Path) -> Mapping[str, Collection[bytes]] | None:
    """Return the requests it has taken, by service; None if it was killed or ran out of space."""
    with contextlib.suppress(StateError, ValueError, TypeError, AttributeError):
        told = disk.read_json(_files(lock)[0])
        return {str(name): set(map(bytes.fromhex, ids)) for name, ids in told.items()}
    return None


def _files(lock: Path) -> tuple[Path, Path]:
    return lock.with_name(f"{lock.stem}-taken.json"), lock.with_name(f"{lock.stem}-order.lock")


def _run(proxy: ClientProxy, limit_s: float, done: Callable[[], bool]) -> bool:
    end, watchdog = time.monotonic() + limit_s, Watchdog()
    while not (over := done()) and time.monotonic() < end:
        proxy.run_once()
        watchdog.work()
    return over


def _takes(report: Path, callers: Mapping[str, int]) -> bool:
    """Whether another proxy offers all of these services, to as many callers at least."""
    with contextlib.suppress(StateError, AttributeError, KeyError, TypeError):
        told = disk.read_json(report)
        theirs = told["callers"]
        if told["pid"] != os.getpid():
            return all(theirs.get(name, -1) >= count for name, count in callers.items())
    return False
