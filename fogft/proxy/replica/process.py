"""``fogft serve --config FILE``: the server proxy process, one per replica.

It exits with status 0 when told to or when its lease expires. Then its parent (a VM's job, the
local cloud's machine) shuts down the machine.
"""

import logging
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fogft.cloud import notice
from fogft.cloud.notice_formats import Notice, NoticeKind
from fogft.link.zenoh.settings import forget_threads
from fogft.metrics import proxies
from fogft.metrics.scrape import Scrape
from fogft.metrics.spans import wanted
from fogft.model.proxy_config import ServerProxyConfig
from fogft.model.type_definition import Definition
from fogft.process import Wakeup, begin_start, end_start, start_log, stop_on_signal
from fogft.proxy import middleware
from fogft.proxy.config import read_server
from fogft.proxy.replica.announcing import Presence
from fogft.proxy.replica.server import ServerProxy
from fogft.proxy.replica.service_queue import Job
from fogft.proxy.replica.supervisor import Supervisor
from fogft.records import cache
from fogft.records.record import RecordKind
from fogft.ros import environment, memory_tuning
from fogft.ros.port import RosNode
from fogft.ros.reservations import Reservation, own_domain, reserve_domain

log = logging.getLogger(__name__)

_TICK_S = 0.05
_IDLE_TICK_S = 0.25  # while all is ready, without topics, actions or stateful services
_LEAVE_S = 4.0
"""From a SIGTERM to the end: robots probe each second, and some clouds kill after five."""


def run(
    config_path: Path,
    *,
    workdir: Path | None = None,
    notice_file: Path | None = None,
    **override: Any,
) -> None:
    """Run until a signal stops it, or until the manager's lease expires.

    Each option that is not None overrides a key of the file. The file `notice_file` appears when
    the machine is about to be preempted.

    Raises FogftError: The configuration, the credentials or ROS cannot be used.
    """
    begin_start()
    config = read_server(
        config_path,
        workdir=str(workdir.resolve()) if workdir else None,
        notice=f"file:{notice_file.resolve()}" if notice_file else None,
        **override,
    )
    start_log()
    stop = stop_on_signal()
    machine_ends = threading.Event()

    def end(*_: object) -> None:
        machine_ends.set()
        stop.set()

    signal.signal(signal.SIGTERM, end)
    died = Wakeup()
    signal.signal(signal.SIGCHLD, lambda *_: died.wake())
    middleware.prepare(config.rmw)
    traced = frozenset(service.name for service in config.services if service.trace)
    spans = wanted("fogft-replica", config.pool) if traced else None

    def answered(job: Job, ended: float) -> None:
        if spans is not None and job.service in traced:
            moments = (job.arrived, job.begun, ended)
            spans.ran(job.id, job.service, config.id.short, moments)

    second = _second_domain(config) if config.spare else None
    proxy = _make(config, answered if spans is not None else None, second)
    watching = None if config.notice == "none" else notice.Watch(config.notice, proxy.noticed)
    presence: Presence | None = None
    scrape = Scrape(
        lambda: proxies.of_server(proxy.report()), {"pool": config.pool, "slot": str(config.slot)}
    )
    try:
        proxy.start()
        scrape.at(config.metrics)
        presence = Presence(config, proxy.endpoint)
        end_start()
        _loop(proxy, presence, stop, died)
        if proxy.lease_is_over:
            log.error("lease_over replica=%s reason='no manager was heard of'", config.id)
        if machine_ends.is_set() and watching is not None and watching.silent:
            # On RunPod, Vast and others, SIGTERM is the only preemption notice, and a short one.
            proxy.noticed(Notice(NoticeKind.PREEMPTION, None, "signal", "SIGTERM"))
            log.warning("notice_received kind=preemption source=signal ends_in_s=%.0f", _LEAVE_S)
            stop.clear()
            _loop(proxy, presence, stop, died, time.monotonic() + _LEAVE_S)
    finally:
        scrape.close()
        if presence is not None:
            presence.close()
        if watching is not None:
            watching.close()
        proxy.close()
        log.info("replica_stopped replica=%s", config.id)


def _second_domain(config: ServerProxyConfig) -> Reservation | None:
    """Reserve a ROS domain for the spare process, for as long as the reservation is kept."""
    own = config.domain_id
    reserved = reserve_domain({own_domain(run_environment(config)) if own is None else own})
    if reserved is None:
        log.error("spare_off reason='no ROS domain is free here'")
    return reserved


def _make(
    config: ServerProxyConfig,
    answered: Callable[[Job, float], None] | None,
    second: Reservation | None,
) -> ServerProxy:
    from fogft.link.zenoh.handshakes import HandshakeLog
    from fogft.link.zenoh.replica.listener import ZenohListener

    environ = run_environment(config)
    joined: list[middleware.Joined] = []  # the current node: it is recreated after a crash

    def define(type_name: str) -> Definition:
        return joined[0].define(type_name)

    def make_node() -> RosNode:
        name = f"fogft_replica_{config.id.slot}"
        joined[:] = [middleware.join(config.rmw, name, proxy.command.domain_id, environ=environ)]
        return joined[0].node

    handshakes = HandshakeLog()
    listener = ZenohListener(config.listen, config.credentials, config.id, handshakes=handshakes)
    listener.take_records(cache.read(config.announcements) if config.announcements else ())

    def command(domain: int | None) -> Supervisor:
        return Supervisor(
            config.run, config.workdir, environ, domain_id=domain, stdout=handshakes.stdout
        )

    proxy = ServerProxy(
        config.id,
        config.services,
        listener,
        make_node,
        command(config.domain_id),
        spare=command(second.number) if second is not None else None,
        define=define,
        topics=config.topics,
        answered=answered,
    )
    return proxy


def run_environment(config: ServerProxyConfig) -> dict[str, str]:
    """Return the environment of the user's command.

    If the proxy runs in a virtual environment, that comes first in PATH, as if activated, so
    ``run: python3 node.py`` finds the same ROS as the proxy.
    """
    environ = environment.child_environment(os.environ)
    forget_threads(environ)
    if sys.prefix != sys.base_prefix:
        environ["VIRTUAL_ENV"] = sys.prefix
        environ["PATH"] = f"{sys.prefix}/bin:{environ.get('PATH', os.defpath)}"
    environ["FOGFT_FILES"] = str(config.credentials.ca.parent)
    environ.update(config.envs)
    return environ


def _loop(
    proxy: ServerProxy,
    presence: Presence,
    stop: threading.Event,
    died: Wakeup,
    until: float = math.inf,
) -> None:
    memory = memory_tuning.Trimmer()
    while time.monotonic() < until and not stop.is_set():
        # Report a crash before robots hedge the request that caused it at another replica.
        died.wait(_IDLE_TICK_S if proxy.idle else _TICK_S)
        proxy.run_once()
        memory.look()
        known = presence.look(proxy.ready, draining=proxy.draining)
        proxy.revoke(known.revoked)
        proxy.renew(known.of(RecordKind.LEASE))
        if proxy.lease_is_over:
            return
