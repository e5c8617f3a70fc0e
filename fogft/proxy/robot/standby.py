"""The standby client proxy, and hand-over to it. Design: docs/design/manager.md.

The standby has loaded everything and its DDS participant is discovered, but it offers no service
and has no visible node. It waits for the lock, which the kernel grants when the holder ends. A
spare waits for the standby's place; it has no ROS or Zenoh threads yet, so it can fork.
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
BEGIN_LIMIT_S = 15.0  # if the standby does not offer our services by then, it has failed
RENEWED_AFTER_S = 0.5  # this long after a pause, a standby has rejoined and is discovered
COPIES = 10  # limit on copies within COPIES_WITHIN_S: they may be failing at once
COPIES_WITHIN_S = 60.0
KNOWN_AFTER_S = 1.0  # time for callers to discover the services of a standby that knows them
ORDER_LIMIT_S = 20.0  # ordered requests are answered by then, or not at all
ANEW_LIMIT_S = 2.0  # without a standby: new requests are answered only after the restart
FINISH_LIMIT_S = 130.0  # all limits together: less than systemd and `fogft service install` wait
_PACED_S = 0.5  # until responses that are paced for their client are sent
# Modules that a client proxy imports only when needed.
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

    Returns early, without the lock, if `stop` is set or the pool's folder is gone. A `spare`
    waits for the standby's place first.

    Raises:
        PoolBusy: There is a standby already, or with `spare` a spare.
        FogftError: ROS cannot be used.
    """
    for module in _NEEDED:
        importlib.import_module(module)
    Signer(config.credentials.certificate, config.credentials.key)  # loads `cryptography`
    place = disk.Lock(disk.standby_lock(config.lock))
    if spare:
        _wait_as_spare(config, place, stop)
    elif not place.acquire(wait=False):  # its holder is ready to take over
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
    """Wait for the standby's place, then fork the next spare."""
    spare, copied = disk.Lock(disk.standby_lock(disk.standby_lock(config.lock))), list[float]()
    while True:
        if not spare.acquire(wait=False):
            raise PoolBusy(f"the standby of pool `{config.pool}` already has a spare")
        log.info("spare_ready pool=%s pid=%d", config.pool, os.getpid())
        taken = _take(place, config, stop)
        spare.release()
        copied = [at for at in copied if at > time.monotonic() - COPIES_WITHIN_S]
        # systemd supervises only processes that it has started.
        if not taken or len(copied) >= COPIES or "NOTIFY_SOCKET" in os.environ or os.fork():
            return
        copied.append(time.monotonic())
        place.release()  # the parent holds it


def _take(
    lock: disk.Lock,
    config: ClientProxyConfig,
    stop: threading.Event,
    look: Callable[[], None] = lambda: None,
) -> bool:
    """Wait for a lock; return whether it was acquired, False if told to stop."""

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
    """Return a function that makes request ids: both proxies of a robot compute the same id.

    Others cannot guess the id: it depends on the robot's private `key`. `identity` returns, for a
    request's handle, what both know the request by; without a ROS request id, the id is random.
    """
    try:
        secret = hashlib.sha256(key.read_bytes()).digest()
    except OSError:  # reported by whoever needs the key
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

    `callers` counts the clients of each service that we offer; `release` gives up the lock and
    everything else that the standby needs. With `dial_in` there is no hand-over: the port cannot be
    shared. If the pool's folder disappears, all waits end.
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
    """Take no more requests and wait briefly for open ones, before this process restarts."""
    proxy.take_no_more()
    _run(proxy, ANEW_LIMIT_S, lambda: proxy.waiting() == 0)


def is_held(lock: Path) -> bool:
    """Whether the proxy that is handing over to us still orders stateful services."""
    return disk.is_locked(_files(lock)[1])


def taken_before(lock: Path) -> Mapping[str, Collection[bytes]] | None:
    """Return the requests that proxy took, by service; None if it was killed or its disk full."""
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
    """Whether another proxy offers all of these services, to at least as many callers."""
    with contextlib.suppress(StateError, AttributeError, KeyError, TypeError):
        told = disk.read_json(report)
        theirs = told["callers"]
        if told["pid"] != os.getpid():
            return all(theirs.get(name, -1) >= count for name, count in callers.items())
    return False
