"""``fogft proxy --config FILE``: the client proxy as a process.

It follows two files, the configuration and the membership, and writes one, its report. It
needs no manager: started alone it goes on with the last membership on disk.
"""

from __future__ import annotations

import functools
import json
import logging
import os
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from fogft import disk
from fogft.disk import Watched
from fogft.errors import FogftError, PoolBusy, StateError
from fogft.link.uplinks import UplinkDialer
from fogft.metrics import proxies
from fogft.metrics.scrape import Scrape
from fogft.model import names
from fogft.model.choices import Speaks
from fogft.model.proxy_config import ClientProxyConfig
from fogft.model.spec import Part, ServiceSpec
from fogft.process import start_log, stop_on_signal
from fogft.proxy import middleware, start
from fogft.proxy.config import read_client
from fogft.proxy.order_mark import OrderMark
from fogft.proxy.robot.actions import Actions
from fogft.proxy.robot.client import ClientProxy
from fogft.proxy.robot.diagnostics_node import SeenFromRos
from fogft.proxy.robot.dispatcher import Dispatcher
from fogft.proxy.robot.following import Following
from fogft.proxy.robot.manager_sign import ManagerSign
from fogft.proxy.robot.service_order import ServiceOrder
from fogft.requests.votes import Quorum
from fogft.ros import memory_tuning
from fogft.ros.port import RosNode, RosTopics

if TYPE_CHECKING:
    from fogft.ros.visible import VisibleNode

log = logging.getLogger(__name__)

_STATEFUL_BYTES = 64 << 20  # of requests; each is in the log of its order, too
TRACE_NAME = "trace.jsonl"
_TRACE_BYTES = 16 << 20
_REPORT_EVERY_S = 0.5
_REPORT_AFTER_CHANGE_S = 0.05
_LOOK_EVERY_S = 0.05  # at files, and what else needs no haste


def run(config_path: Path, *, metrics: str | None = None) -> None:
    """Run until a signal ends it.

    Args:
        config_path: A `proxy.yaml`.
        metrics: ``host:port`` to answer Prometheus at, instead of the file's.

    Raises:
        PoolBusy: This pool's client proxy runs already.
        FogftError: The configuration, the credentials or ROS cannot be used.
    """
    start.begin()
    start_log()
    stop = stop_on_signal()
    config = read_client(config_path, metrics)
    lock = disk.Lock(config.lock)
    if not lock.acquire(wait=False):
        raise PoolBusy(f"the client proxy of pool `{config.pool}` runs already")
    middleware.prepare(config.rmw)
    from fogft.ros import goal_status
    from fogft.ros.types import check_ok_field

    sign = ManagerSign(config.lease)
    made: list[ClientProxy] = []  # the node asks the proxy that is made with it
    joined = middleware.join(
        config.rmw,
        _node_name("fogft_proxy", config.pool),
        config.domain_id,
        told=lambda: made[0].types_behind() if made else {},
        noticed=lambda: made[0].types_changed() if made else None,
    )
    make = functools.partial(
        make_dispatcher,
        marks=config.status.with_suffix(".marks"),
        pool_uid=config.pool_uid,
        actions=Actions(),
        speaks=config.rmw,
    )
    dialer = make_dialer(config, sign.age_s)
    proxy = ClientProxy(
        config.pool_uid, joined.node, dialer, make, define=joined.define, merge=goal_status.merged
    )
    made.append(proxy)
    visible = functools.partial(_make_visible, joined, _node_name("fogft", config.pool))
    seen = SeenFromRos(config.pool, config.robot, visible, check_ok_field)
    proxy.serve(seen.follow(config.services))
    proxy.pass_topics(config.topics, cast(RosTopics, joined.node))
    following = Following(config)
    scrape = Scrape(lambda: proxies.of_client(proxy.report()), {"pool": config.pool})
    scrape.at(config.metrics)
    log.info("proxy_started pool=%s robot=%s pid=%d", config.pool, config.robot, os.getpid())
    try:
        parts = _Parts(proxy, following, sign, dialer, seen, scrape, metrics, joined.node)
        start.settle()
        _loop(config_path, config, parts, stop)
    finally:
        scrape.close()
        following.close()
        proxy.close()
        joined.node.close()
        lock.release()
        log.info("proxy_stopped pool=%s", config.pool)


def _make_visible(
    joined: middleware.Joined, name: str, judge: Callable[[Mapping[str, Any]], str]
) -> VisibleNode | None:
    """Make the node that people see. Without it requests flow all the same."""
    try:
        return joined.make_visible(name, judge)
    except FogftError as error:
        log.error("visible_node_off reason=%r", error.message)
        return None


def make_dialer(config: ClientProxyConfig, manager_age: Callable[[], float | None]) -> UplinkDialer:
    """Make the dialer of a proxy, or of a gateway.

    With several uplinks one is suspected in half the time: a false alarm costs a copy, no more.
    """
    from fogft.link.zenoh.robot.dialer import ZenohDialer

    several = len(config.uplinks) > 1
    dialer = UplinkDialer(
        ZenohDialer(
            config.credentials,
            robot=config.robot,
            pool_uid=config.pool_uid,
            suspect_after_s=config.suspect_after_s / 2 if several else config.suspect_after_s,
            manager_age=manager_age,
            tell_losers=config.tell_losers,
        )
    )
    dialer.use(config.uplinks, config.services)
    return dialer


def make_dispatcher(
    spec: ServiceSpec,
    respond: Callable[[Any, bytes], None],
    wake: Callable[[], None],
    *,
    marks: Path,
    pool_uid: str,
    actions: Actions,
    speaks: Speaks = Speaks.RCLPY,
) -> Dispatcher:
    """Make the dispatcher of a service, with what its policy needs of its ROS type.

    Args:
        spec: The service.
        respond: Sends a response to the caller of a handle.
        wake: Has the dispatcher's `tick` called soon.
        marks: Folder of the stateful services' marks.
        pool_uid: Whose marks they are.
        actions: Makes those of actions.
        speaks: How the proxy speaks ROS. Over Zenoh a type need not be known.

    Raises:
        RosError: The type is needed and cannot be loaded.
    """
    fault_of = middleware.response_fault(spec.type)
    if spec.part is not Part.NONE:
        return actions.make(spec, respond, wake, fault_of)
    from fogft.ros import types
    from fogft.ros.comparison import Comparison

    # The policy may become `empty` later.
    empty = middleware.empty_response(speaks, spec.type, needed=spec.needs_type)
    make = functools.partial(
        Dispatcher, spec, respond, empty_response=empty, wake=wake, fault_of=fault_of
    )
    if spec.state is not None:
        mark = marks / f"{names.connection_id(pool_uid, 0, spec.name, spec.type)}"
        order = ServiceOrder(spec.name, OrderMark(mark, pool_uid), wake=wake)
        return make(decide=order, replication=order, max_pending_bytes=_STATEFUL_BYTES)
    ok_of = functools.partial(types.bool_field, spec.type)
    if spec.quorum > 1:
        comparison = Comparison(spec.type, dict(spec.tolerance))
        flagged = functools.partial(_replica_disagrees, spec.name)
        return make(decide=Quorum(spec.quorum, comparison, flagged), ok_of=ok_of)
    return make(ok_of=ok_of)


def _replica_disagrees(service: str, replica: int, count: int) -> None:
    log.error("replica_disagrees service=%s replica=%d.%d count=%d",
              service, replica >> 32, replica & 0xFFFFFFFF, count)  # fmt: skip


class _Parts(NamedTuple):
    proxy: ClientProxy
    following: Following
    sign: ManagerSign
    dialer: UplinkDialer
    seen: SeenFromRos
    scrape: Scrape
    metrics: str | None
    node: RosNode


def _loop(
    config_path: Path,
    config: ClientProxyConfig,
    parts: _Parts,
    stop: threading.Event,
) -> None:
    proxy, following, sign, seen = parts.proxy, parts.following, parts.sign, parts.seen
    memory = memory_tuning.Trimmer()
    watched_config = Watched(config_path)
    watched_config.changed()
    watched_certificate = Watched(config.credentials.certificate)  # written after its key
    watched_certificate.changed()
    revocations = Watched(config.revocations) if config.revocations else None
    started = reported = looked = time.monotonic()
    changed = False  # since the last report
    while not stop.is_set():
        changed = proxy.run_once() or changed
        now = time.monotonic()
        if now - looked < _LOOK_EVERY_S:  # requests' own deadlines are seen to by `run_once`
            continue
        looked = now
        memory.look()
        sign.look()
        if watched_config.changed():
            try_step(functools.partial(_reconfigure, config_path, config, parts), config_path)
        try_step(functools.partial(_follow_parameters, parts), config_path)
        try_step(functools.partial(_follow, following, proxy), config.membership)
        if watched_certificate.changed():
            proxy.renew()
            following.renew()
        if revocations is not None and revocations.changed():
            try_step(functools.partial(_tell, revocations.path, proxy), revocations.path)
        seen.diagnose(proxy.report, now)
        if now - reported > (_REPORT_AFTER_CHANGE_S if changed else _REPORT_EVERY_S):
            reported, changed = now, False
            if not config_path.parent.exists():  # the pool's folder: its end is the pool's
                log.warning("folder_gone path=%s", config_path.parent)
                return
            report = {**proxy.report(), **following.report()}
            try_step(functools.partial(_report, config, report, now - started), config.status)
            trace = config.status.with_name(TRACE_NAME)
            try_step(functools.partial(_write_trace, trace, proxy), trace)


_troubles: dict[Path, str] = {}


def try_step(step: Callable[[], None], path: Path) -> None:
    """Do one step; a bad file, or a full disk, is logged once and changes nothing."""
    try:
        step()
    except FogftError as error:
        if _troubles.get(path) != error.message:
            _troubles[path] = error.message
            log.error("file_failed path=%s reason=%r", path, error.message)
    else:
        _troubles.pop(path, None)


def _reconfigure(path: Path, old: ClientProxyConfig, parts: _Parts) -> None:
    new = read_client(path, parts.metrics)
    fixed = (new.pool_uid, new.domain_id, new.rmw)
    if fixed != (old.pool_uid, old.domain_id, old.rmw):
        raise StateError(
            f"`{path}`: pool_uid, domain_id and rmw cannot change while the proxy runs"
        )
    if parts.dialer.use(new.uplinks, new.services):
        parts.proxy.redial()
    parts.proxy.serve(parts.seen.follow(new.services))
    parts.proxy.pass_topics(new.topics, cast(RosTopics, parts.node))
    parts.following.apply(new)
    parts.scrape.at(new.metrics)
    log.info("config_applied services=%d", len(new.services))


def _follow_parameters(parts: _Parts) -> None:
    services = parts.seen.changed()
    if services is not None:
        parts.proxy.serve(services)


def _follow(following: Following, proxy: ClientProxy) -> None:
    membership = following.look()
    if membership is not None:
        proxy.follow(membership)


def _tell(path: Path, proxy: ClientProxy) -> None:
    from fogft.records import cache

    proxy.tell(cache.read(path))


def _report(config: ClientProxyConfig, report: Mapping[str, Any], uptime_s: float) -> None:
    header = {
        "pid": os.getpid(),
        "written_at": time.time(),
        "uptime_s": uptime_s,
        "robot": config.robot,
    }
    disk.write_json(config.status, {**header, **report}, durable=False)


def _write_trace(path: Path, proxy: ClientProxy) -> None:
    """Append how requests ended, a JSON object a line; keep one older file."""
    lines = proxy.trace()
    if not lines:
        return
    at = round(time.time(), 3)
    try:
        if path.exists() and path.stat().st_size > _TRACE_BYTES:
            path.replace(path.with_name(path.name + ".1"))
        with path.open("a") as file:
            file.writelines(json.dumps({"at": at, **line}) + "\n" for line in lines)
    except OSError as error:
        raise StateError(f"`{path}` cannot be written: {error.strerror}") from error


def _node_name(prefix: str, pool: str) -> str:
    return f"{prefix}_{pool.replace('-', '_')}"
