"""``fogft gateway --config FILE``: a gateway as a process. It needs no ROS."""

import functools
import logging
import os
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fogft import disk
from fogft.errors import CredentialError, FogftError, PoolBusy
from fogft.link.port import Probe, ProbeAnswer
from fogft.metrics import proxies
from fogft.metrics.scrape import Scrape
from fogft.model import names
from fogft.model.credentials import Holder, Role
from fogft.model.proxy_config import ClientProxyConfig
from fogft.model.replica import ReplicaId
from fogft.model.spec import OnTimeout, ServiceSpec
from fogft.model.type_definition import RESPONSE
from fogft.process import Watchdog, notify, on_thread, start_log, stop_on_signal
from fogft.proxy.config import read_client
from fogft.proxy.gateway.gateway import Forwarder
from fogft.proxy.middleware import fault_of
from fogft.proxy.robot.client import ClientProxy
from fogft.proxy.robot.dispatcher import Dispatcher, Wake
from fogft.proxy.robot.following import Following
from fogft.proxy.robot.process import make_dialer, try_step

if TYPE_CHECKING:
    from fogft.link.zenoh.replica.listener import ZenohListener

log = logging.getLogger(__name__)

_REPORT_EVERY_S = 0.5


def run(config_path: Path, *, listen: str | None = None, metrics: str | None = None) -> None:
    """Run until a signal stops it; each option overrides a key of the file.

    Raises PoolBusy: This gateway is already running.
    """
    start_log()
    stop = stop_on_signal()
    config = read_client(config_path, listen=listen, metrics=metrics)
    lock = disk.Lock(config.lock)
    if not lock.acquire(wait=False):
        name, pool = config.robot, config.pool
        raise PoolBusy(f"gateway `{name}` of pool `{pool}` is already running")
    gateway = _Gateway(config)
    try:
        gateway.run(stop)
    finally:
        gateway.close()
        lock.release()
        log.info("gateway_stopped gateway=%s", config.robot)


class _Gateway:
    def __init__(self, config: ClientProxyConfig) -> None:
        from fogft.link.zenoh.handshakes import HandshakeLog

        self._handshakes = HandshakeLog()
        self._config = config
        self._status = disk.Report(config.status)
        self._incarnation = secrets.token_hex(8)
        self._forwarder = Forwarder()
        dialer = make_dialer(config)
        self._proxy = ClientProxy(config.pool_uid, None, dialer, self._make_dispatcher)
        # What a caller gets after a time-out is decided on the robot.
        self._services = tuple(
            replace(service, on_timeout=OnTimeout.SILENT, fallback=None)
            for service in config.services
        )
        self._proxy.serve(self._services)
        self._following = Following(config)
        self._revoked: frozenset[str] = frozenset()
        self._listener: ZenohListener | None = None
        self._holder = self._own_holder()
        self._certificate = disk.Watched(config.credentials.certificate, from_now=True)
        self._scrape = Scrape(lambda: proxies.of_gateway(self._told()), {"pool": config.pool})

    def _own_holder(self) -> Holder:
        holder = self._following.holder()
        if holder.role is not Role.GATEWAY:
            raise CredentialError(
                f"`{holder.common_name}` is not a gateway's certificate",
                "`fogft credentials issue gateway NAME` creates one",
            )
        return holder

    def _make_dispatcher(
        self, spec: ServiceSpec, respond: Callable[[Any, bytes], None], wake: Wake
    ) -> Dispatcher:
        dispatcher = Dispatcher(
            spec,
            self._forwarder.respond,
            fault_of=fault_of(spec.type, RESPONSE),
            ok_of=functools.partial(_ok_of, spec.type),
            wake=wake,
            poisoned=self._forwarder.poisoned,
        )
        self._forwarder.dispatchers[spec.name] = dispatcher
        return dispatcher

    def _listen(self) -> None:
        from fogft.link.zenoh.replica.listener import ZenohListener

        uid, slot = self._config.pool_uid, names.gateway_slot(self._holder.name)
        listener = ZenohListener(
            self._config.listen,
            self._config.credentials,
            ReplicaId(uid, slot, self._holder.generation),
            handshakes=self._handshakes,
            certificate_name=self._holder.common_name,
        )
        keys = names.service_keys(uid, slot, {s.name: s.type for s in self._services})
        listener.revoke(self._revoked)
        listener.serve(keys, self._forwarder.request, self._probed, self._forwarder.cancel)
        self._listener = listener
        log.info("gateway_listening gateway=%s endpoint=%s", self._holder.short, listener.endpoint)

    def _probed(self, probe: Probe) -> ProbeAnswer:
        ready = self._proxy.links.ready
        return ProbeAnswer(
            slot=names.gateway_slot(self._holder.name),
            generation=self._holder.generation,
            incarnation=self._incarnation,
            ready=ready,
            in_flight=self._forwarder.in_flight,
            work=self._forwarder.work(),
            detail="" if ready else "no replica behind it answers",
            behind=self._proxy.behind(),
            types=self._proxy.links.types() if probe.describe else {},
        )

    def run(self, stop: threading.Event) -> None:
        # A thread of its own, since the link's threads must not send.
        on_thread(self._forwarder.pass_on, name="fogft-forward")
        self._listen()
        self._scrape.at(self._config.metrics)
        reported, watchdog = time.monotonic(), Watchdog()
        notify("READY=1")
        while not stop.is_set():
            watchdog.work()
            self._proxy.run_once()
            self._forwarder.tick(self._proxy.links.ready)
            try_step(self._follow, self._config.membership)
            if self._certificate.changed() and not try_step(self._renew, self._certificate.path):
                self._certificate.forget()
            if time.monotonic() - reported > _REPORT_EVERY_S:
                reported = time.monotonic()
                self._report()

    def _follow(self) -> None:
        membership = self._following.look()
        if membership is not None:
            self._proxy.follow(membership)
            self._revoked |= membership.revoked
            if self._listener is not None:
                self._listener.revoke(self._revoked)

    def _renew(self) -> None:
        """Switch to a new certificate: the listener at once, links one by one."""
        self._holder = self._own_holder()
        if self._listener is not None:
            self._listener.close()
        self._listen()
        self._proxy.renew()
        self._following.renew()

    def _told(self) -> dict[str, Any]:
        return {
            "forwarded": self._forwarder.report(),
            "listener": dict(self._listener.counters()) if self._listener else {},
            **self._proxy.report(),
        }

    def _report(self) -> None:
        report = {
            "pid": os.getpid(),
            "written_at": time.time(),
            "gateway": self._holder.short,
            "endpoint": self._listener.endpoint if self._listener else "",
            **self._told(),
            **self._following.report(),
        }
        try_step(functools.partial(self._status.write, report), self._config.status)

    def close(self) -> None:
        self._scrape.close()
        self._forwarder.close()
        if self._listener is not None:
            self._listener.close()
        self._following.close()
        self._proxy.close()


def _ok_of(type_name: str, field: str) -> Callable[[bytes], bool]:
    """Return a check whether a response is ok; if the type is unknown here, every one is."""
    try:
        from fogft.ros import messages

        return messages.bool_field(type_name, field)
    except (FogftError, ImportError) as error:
        log.warning(
            "ok_field_not_judged type=%s reason=%r effect='the first response is returned'",
            type_name, str(error),
        )  # fmt: skip
        return lambda payload: True
