"""``fogft serve --config FILE``: the server proxy as a process, one a replica.

It ends with status 0 when it was told to or when it is orphaned; whoever started it (a VM's
job, the local cloud's machine) then ends the machine.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
from pathlib import Path

from fogft.cloud import notice
from fogft.link.zenoh import runtime
from fogft.metrics import proxies
from fogft.metrics.scrape import Scrape
from fogft.model.proxy_config import ServerProxyConfig
from fogft.model.type_definition import Definition
from fogft.process import start_log, stop_on_signal
from fogft.proxy import middleware, start
from fogft.proxy.announcing import Presence
from fogft.proxy.config import read_server
from fogft.proxy.replica.server import ServerProxy
from fogft.proxy.replica.supervisor import Supervisor
from fogft.records import cache
from fogft.ros import environment, memory_tuning
from fogft.ros.port import RosNode

log = logging.getLogger(__name__)

_TICK_S = 0.05


def run(
    config_path: Path,
    *,
    listen: str | None = None,
    domain_id: int | None = None,
    workdir: Path | None = None,
    notice_file: Path | None = None,
    advertise: str | None = None,
    metrics: str | None = None,
) -> None:
    """Run until a signal ends it, or until no manager was heard of for `orphan_after_s`.

    Args:
        config_path: A `replica.yaml`.
        listen: ``host:port`` instead of the file's.
        domain_id: ROS domain instead of the file's.
        workdir: Folder in which `run` starts, instead of the file's.
        notice_file: File that appears when the machine is about to be preempted.
        advertise: ``host:port`` at which this replica is reached, where it cannot know that.
        metrics: ``host:port`` to answer Prometheus at, instead of the file's.

    Raises:
        FogftError: The configuration, the credentials or ROS cannot be used.
    """
    start.begin()
    config = read_server(
        config_path,
        listen=listen,
        domain_id=domain_id,
        workdir=str(workdir.resolve()) if workdir else None,
        notice=f"file:{notice_file.resolve()}" if notice_file else None,
        advertise=advertise,
        metrics=metrics,
    )
    start_log(config.log_level)
    stop = stop_on_signal()
    middleware.prepare(config.rmw)
    proxy = _make(config)
    watching = None if config.notice == "none" else notice.watch(config.notice, proxy.noticed)
    presence: Presence | None = None
    scrape = Scrape(
        lambda: proxies.of_server(proxy.report()), {"pool": config.pool, "slot": str(config.slot)}
    )
    try:
        proxy.start()
        scrape.at(config.metrics)
        presence = Presence(config, proxy.endpoint)
        start.settle()
        _loop(config, proxy, presence, stop)
    finally:
        scrape.close()
        if presence is not None:
            presence.close()
        if watching is not None:
            watching.close()
        proxy.close()
        log.info("replica_stopped replica=%s", config.id)


def _make(config: ServerProxyConfig) -> ServerProxy:
    from fogft.link.zenoh.handshakes import HandshakeLog
    from fogft.link.zenoh.replica.listener import ZenohListener
    from fogft.ros.state_bytes import StateBytes

    environ = run_environment(config)
    joined: list[middleware.Joined] = []  # the newest last: the node is made anew after a crash

    def define(type_name: str) -> Definition:
        return joined[0].define(type_name)

    def make_node() -> RosNode:
        name = f"fogft_replica_{config.id.slot}"
        joined[:] = [middleware.join(config.rmw, name, config.domain_id, environ=environ)]
        return joined[0].node

    handshakes = HandshakeLog()
    listener = ZenohListener(config.listen, config.credentials, config.id, handshakes=handshakes)
    listener.take_records(cache.read(config.revocations) if config.revocations else ())
    return ServerProxy(
        config.id,
        config.services,
        listener,
        make_node,
        Supervisor(config.run, config.workdir, environ, stdout=handshakes.stdout),
        make_state=StateBytes,
        define=define,
        topics=config.topics,
        max_in_flight=config.max_in_flight,
        orphan_after_s=config.orphan_after_s,
    )


def run_environment(config: ServerProxyConfig) -> dict[str, str]:
    """Return what the user's command finds in its environment.

    In a virtual environment its own `python3` comes first, as if it were activated, so that
    ``run: python3 node.py`` finds the same ROS as the proxy.
    """
    environ = environment.child_environment(os.environ)
    runtime.forget(environ)
    if sys.prefix != sys.base_prefix:
        environ["VIRTUAL_ENV"] = sys.prefix
        environ["PATH"] = f"{sys.prefix}/bin:{environ.get('PATH', os.defpath)}"
    environ.update(config.envs)
    if config.domain_id is not None:
        environ["ROS_DOMAIN_ID"] = str(config.domain_id)
    return environ


def _loop(
    config: ServerProxyConfig, proxy: ServerProxy, presence: Presence, stop: threading.Event
) -> None:
    memory = memory_tuning.Trimmer()
    while not stop.wait(_TICK_S):
        proxy.run_once()
        memory.look()
        proxy.revoke(
            presence.look(proxy.ready, draining=proxy.draining, in_flight=proxy.responder.in_flight)
        )
        if proxy.orphaned:
            log.error(
                "replica_orphaned replica=%s orphan_after_s=%.0f", config.id, config.orphan_after_s
            )
            return
