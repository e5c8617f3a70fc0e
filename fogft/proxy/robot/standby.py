"""The next client proxy, in line behind the one that works.

It has loaded everything and its DDS participant is known, but it offers nothing and no node of it
is seen. It waits for the lock: the kernel gives it in the instant in which the holder ends,
whatever ends it.

Owns: the place in line. Not here: a client proxy's work (`process`).
"""

from __future__ import annotations

import importlib
import logging
import threading
import time
from typing import TYPE_CHECKING

from fogft import disk
from fogft.errors import PoolBusy
from fogft.model.proxy_config import ClientProxyConfig
from fogft.process import Watchdog, notify
from fogft.proxy import middleware
from fogft.records.signing import Signer

if TYPE_CHECKING:
    from fogft.ros.participant.joining import EarlyJoin

log = logging.getLogger(__name__)

LOOK_S = 0.2
# What a client proxy imports only when it needs it.
_NEEDED = ("fogft.link.zenoh.robot.dialer", "fogft.proxy.robot.process", "fogft.ros.goal_status")


def wait(
    config: ClientProxyConfig, lock: disk.Lock, stop: threading.Event, node: str
) -> EarlyJoin | None:
    """Prepare all that can be, then wait for the lock; return what was prepared of ROS.

    Returns early, without the lock, when `stop` is set or the pool's folder is gone.

    Raises:
        PoolBusy: Another one is next in line already.
        FogftError: ROS cannot be used.
    """
    early = _prepare(config, node)
    place = disk.Lock(disk.standby_lock(config.lock))
    if not place.acquire(wait=False):  # whoever holds it is ready to take over
        if early is not None:
            early.close()
        raise PoolBusy(f"the client proxy of pool `{config.pool}` has a standby already")
    log.info("standby_ready pool=%s", config.pool)
    ours, watchdog = _taken(lock), Watchdog()
    notify("READY=1")
    while not ours.wait(LOOK_S):
        watchdog.work()
        if stop.is_set() or not config.lock.parent.exists():
            stop.set()
            if early is not None:
                early.close()
            break
    place.release()
    return early


def _prepare(config: ClientProxyConfig, node: str) -> EarlyJoin | None:
    for module in _NEEDED:
        importlib.import_module(module)
    Signer(config.credentials.certificate, config.credentials.key)  # loads `cryptography`
    middleware.load_types([service.type for service in config.services])
    return middleware.join_early(config.rmw, node, config.domain_id)


def _taken(lock: disk.Lock) -> threading.Event:
    """Return an event that is set once we have the lock."""
    taken = threading.Event()

    def take() -> None:
        while not taken.is_set():
            try:
                if lock.acquire(wait=True):
                    taken.set()
            except OSError as error:  # no descriptor, or the folder is gone
                log.error("lock_failed reason=%r", str(error))
                time.sleep(LOOK_S)

    threading.Thread(target=take, name="standby", daemon=True).start()
    return taken
