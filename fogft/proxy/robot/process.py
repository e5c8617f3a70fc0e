"""``fogft proxy --config FILE``: the client proxy as a process.

It watches two files, the configuration and the membership, and writes its report. It needs no
manager: started alone, it uses the last membership on disk.
"""

import contextlib
import functools
import json
import logging
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from fogft import __version__, disk
from fogft.errors import FogftError, PoolBusy, RosError, StateError
from fogft.link.uplinks import UplinkDialer
from fogft.metrics import proxies
from fogft.metrics.scrape import Scrape
from fogft.metrics.spans import Spans, wanted
from fogft.model import names
from fogft.model.proxy_config import ClientProxyConfig
from fogft.model.replica import short
from fogft.model.spec import Part, ServiceSpec
from fogft.model.type_definition import RESPONSE
from fogft.process import Watchdog, begin_start, end_start, notify, start_log, stop_on_signal
from fogft.proxy import middleware
from fogft.proxy.config import read_client
from fogft.proxy.robot import standby as in_line
from fogft.proxy.robot.actions import Actions
from fogft.proxy.robot.client import ClientProxy
from fogft.proxy.robot.diagnostics import SeenFromRos
from fogft.proxy.robot.dispatcher import Dispatcher, Wake
from fogft.proxy.robot.following import Following
from fogft.proxy.robot.manager_restart import ManagerRestart
from fogft.proxy.robot.order_mark import OrderMark
from fogft.proxy.robot.service_order import ServiceOrder
from fogft.records import cache
from fogft.requests.votes import Quorum
from fogft.ros import memory_tuning, spdp
from fogft.ros.joining import EarlyJoin, Pauses
from fogft.ros.reservations import own_domain
from fogft.ros.visible import VisibleNode

if TYPE_CHECKING:
    from fogft.ros.node import SerialisedNode

log = logging.getLogger(__name__)

_STATEFUL_BYTES = 64 << 20  # limit on open requests; each is in the order's log, too
TRACE_NAME = "trace.jsonl"
_TRACE_BYTES = 16 << 20
_REPORT_EVERY_S = 1.0
_REPORT_AFTER_CHANGE_S = 0.05
_LOOK_EVERY_S = 0.25  # at files and other things that are not urgent


def run(
    config_path: Path, *, metrics: str | None = None, standby: bool = False, spare: bool = False
) -> None:
    """Run until a signal stops it.

    Args:
        metrics: Overrides the file's `metrics`.
        standby: If a proxy is already running, wait until it ends and take over at once.
        spare: The same, but if there is a standby already, first wait for its place.

    Raises:
        PoolBusy: This pool's client proxy is already running; with `standby`, another standby
            too; with `spare`, another spare.
        FogftError: The configuration, the credentials or ROS cannot be used.
    """
    begin_start()
    start_log()
    stop = stop_on_signal()
    config = read_client(config_path, metrics=metrics)
    managing = ManagerRestart(config.lock.parent, os.environ)
    lock = disk.Lock(config.lock)
    middleware.prepare(config.rmw)
    early = None
    if not lock.acquire(wait=False):
        if not (standby or spare):
            raise PoolBusy(f"the client proxy of pool `{config.pool}` is already running")
        name = _node_name("fogft_proxy", config.pool)
        early = in_line.wait(config, lock, stop, name, spare=spare)
        if stop.is_set():
            return
        config = _same(config, read_client(config_path, metrics=metrics), config_path)
    _bury(config)
    running = _Running(
        config_path, config, metrics=metrics, lock=lock, managing=managing, early=early
    )
    handed_over = False
    try:
        end_start()
        notify("READY=1")
        renewed = running.loop(stop)
        if renewed or stop.is_set():
            handed_over = in_line.hand_over(config, running.proxy, running.callers, running.release)
        if renewed and not handed_over:
            in_line.start_anew(running.proxy)
    finally:
        running.close()
        log.info("proxy_stopped pool=%s", config.pool)
    if renewed and not stop.is_set():
        if not handed_over:
            os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
        raise RosError("this process was stopped for too long, and has handed over to its standby")


def make_dialer(config: ClientProxyConfig) -> UplinkDialer:
    """Create the dialer of a proxy or gateway.

    With several uplinks, a link is suspected in half the time: a false alarm only costs a copy.
    """
    from fogft.link.zenoh.robot.dialer import ZenohDialer

    several = len(config.uplinks) > 1
    dialer = UplinkDialer(
        ZenohDialer(
            config.credentials,
            robot=config.robot,
            pool_uid=config.pool_uid,
            suspect_after_s=config.suspect_after_s / 2 if several else config.suspect_after_s,
            tell_losers=config.tell_losers,
        )
    )
    dialer.use(config.uplinks, config.services)
    return dialer


class _Running:
    """A running client proxy, with everything that its main loop looks after."""

    def __init__(
        self,
        config_path: Path,
        config: ClientProxyConfig,
        *,
        metrics: str | None,
        lock: disk.Lock,
        managing: ManagerRestart,
        early: EarlyJoin | None,
    ) -> None:
        from fogft.ros.messages import bool_field, merged_status
        from fogft.ros.types import trouble

        began = time.monotonic()
        self.config_path, self.metrics, self.config = config_path, metrics, config
        self.lock, self.managing = lock, managing
        self.held = in_line.is_held(config.lock)
        made: list[ClientProxy] = []  # the proxy, once created: the node needs it and vice versa
        joined = self.joined = middleware.join(
            config.rmw,
            _node_name("fogft_proxy", config.pool),
            config.domain_id,
            early=early,
            told=lambda: made[0].links.told() if made else {},
            noticed=lambda: made[0].look_again() if made else None,
        )
        self.actions = Actions()
        self.id_of = in_line.request_ids(config.credentials.key, joined.identity)
        self.dialer, make, merge = make_dialer(config), self._make_dispatcher, merged_status
        proxy = self.proxy = ClientProxy(
            config.pool_uid, joined.node, self.dialer, make, define=joined.define, merge=merge
        )
        made.append(proxy)
        check_field = functools.partial(trouble, bool_field)
        self.seen = SeenFromRos(config.pool, config.robot, self._make_visible, check_field)
        self.again = False  # whether to try the configuration again
        try:
            proxy.serve(self.seen.follow(config.services))
        except RosError:
            if not proxy.report()["services"]:
                raise
            self.again = True
        proxy.pass_topics(config.topics, cast("SerialisedNode", joined.node))
        self.following = Following(config)
        self.told = disk.Report(config.status)
        self.scrape = Scrape(lambda: proxies.of_client(proxy.report()), {"pool": config.pool})
        self.scrape.at(config.metrics)
        self.spans = wanted("fogft-robot", config.pool)
        log.info(
            "proxy_started pool=%s robot=%s pid=%d standby=%s start_s=%.2f",
            config.pool, config.robot, os.getpid(), early is not None, time.monotonic() - began,
        )  # fmt: skip

    def _make_dispatcher(
        self, spec: ServiceSpec, respond: Callable[[Any, bytes], None], wake: Wake
    ) -> Dispatcher:
        """Create a service's dispatcher. Raises RosError: its type is needed and not usable."""
        from fogft.ros import messages

        pool_uid = self.config.pool_uid
        fault_of = middleware.fault_of(spec.type, RESPONSE)
        shared: dict[str, Any] = {"wake": wake, "fault_of": fault_of, "id_of": self.id_of}
        if spec.part is not Part.NONE:
            return self.actions.make(spec, respond, **shared)
        # The policy may change to `empty` later.
        empty = middleware.empty_response(self.config.rmw, spec.type, needed=spec.needs_type)
        make = functools.partial(Dispatcher, spec, respond, empty_response=empty, **shared)
        if spec.state is not None:
            marks = self.config.status.with_suffix(".marks")
            mark = marks / names.connection_id(pool_uid, 0, spec.name, spec.type)
            order = ServiceOrder(spec.name, OrderMark(mark, pool_uid), wake=wake, held=self.held)
            return make(decide=order, max_pending_bytes=_STATEFUL_BYTES)
        ok_of = functools.partial(messages.bool_field, spec.type)
        if spec.quorum > 1:
            comparison = messages.Comparison(spec.type, spec.tolerance)

            def flagged(replica: int, count: int) -> None:
                log.error("replica_disagrees service=%s replica=%s count=%d",
                          spec.name, short(replica), count)  # fmt: skip

            decide = Quorum(spec.quorum, comparison.read, comparison.agree, flagged)
            return make(decide=decide, ok_of=ok_of)
        return make(ok_of=ok_of)

    def _make_visible(self, judge: Callable[[Mapping[str, Any]], str]) -> VisibleNode | None:
        try:
            return self.joined.make_visible(_node_name("fogft", self.config.pool), judge)
        except FogftError as error:
            log.error("visible_node_off reason=%r", error.message)
            return None

    def close(self) -> None:
        """Close everything and release the lock, so that another proxy can take over."""
        self.managing.close()
        self.scrape.close()
        self.following.close()
        self.proxy.close()
        self.joined.node.close()
        self.lock.release()

    def callers(self) -> dict[str, int]:
        return {name: self.joined.callers(name) for name in self.proxy.offered}

    def release(self) -> None:
        """Let another proxy take over: it must not declare us dead, and needs our ports."""
        self.scrape.close()
        self.following.close()
        try_step(self._forget_participant, self.config.status)
        self.lock.release()

    def _forget_participant(self) -> None:
        status = self.config.status
        told = disk.read_json(status)
        if isinstance(told, dict):
            disk.write_json(status, {**told, "participant": ""}, durable=False)

    def loop(self, stop: threading.Event) -> bool:
        """Serve until told to stop, or until the pool's folder is gone.

        Returns True if another process must go on, because this one was suspended for long.
        """
        proxy, config, folder = self.proxy, self.config, self.config_path.parent
        memory, watchdog = memory_tuning.Trimmer(), Watchdog()
        watched_config = disk.Watched(self.config_path, from_now=True)
        # The certificate is written after its key.
        watched_certificate = disk.Watched(config.credentials.certificate, from_now=True)
        announcements = disk.Watched(config.announcements) if config.announcements else None
        started = reported = time.monotonic()
        looked = 0.0
        changed = False  # since the last report
        participant, pauses, renew_at = b"", Pauses(), math.inf
        while not stop.is_set():
            changed = proxy.run_once(_LOOK_EVERY_S) or changed
            now = time.monotonic()
            if now - looked < _LOOK_EVERY_S:  # `run_once` handles the deadlines of requests
                continue
            looked = now
            memory.look()
            watchdog.work()
            self.joined.node.look()
            if pauses.was_long():
                renew_at = now + in_line.RENEWED_AFTER_S
            if now >= renew_at:
                return True
            try_step(self.managing.look, config.lock)
            if self.held:
                try_step(self._take_over, config.lock)
            if watched_config.changed():
                self.again = not try_step(self._reconfigure, self.config_path)
            if (services := self.seen.changed()) is not None:
                try_step(functools.partial(proxy.serve, services), self.config_path)
            try_step(self._follow, config.membership)
            if watched_certificate.changed():
                proxy.renew()
                self.following.renew()
            if announcements is not None and announcements.changed():
                try_step(lambda: proxy.tell(cache.read(announcements.path)), announcements.path)
            if now - reported > (_REPORT_AFTER_CHANGE_S if changed else _REPORT_EVERY_S):
                reported, changed = now, False
                if self.again:
                    watched_config.forget()
                if self.lock.lost or not folder.exists():  # without it the pool has ended
                    log.warning("folder_gone path=%s", folder)
                    return False
                # The DDS participant id of this process, once it offers a service.
                ids = map(self.joined.participant, proxy.offered)
                participant = participant or next(filter(None, ids), b"")
                told = {"uptime_s": now - started, "participant": participant.hex()}
                try_step(functools.partial(self._report, told, now), config.status)
                trace = config.status.with_name(TRACE_NAME)
                try_step(functools.partial(_trace, trace, proxy, self.spans), trace)
        return False

    def _take_over(self) -> None:
        if not in_line.is_held(self.config.lock):
            self.held = False
            self.proxy.take_over(in_line.taken_before(self.config.lock))

    def _reconfigure(self) -> None:
        path = self.config_path
        new = _same(self.config, read_client(path, metrics=self.metrics), path)
        if self.dialer.use(new.uplinks, new.services):
            self.proxy.redial()
        self.proxy.pass_topics(new.topics, cast("SerialisedNode", self.joined.node))
        self.following.apply(new)
        self.scrape.at(new.metrics)
        self.proxy.serve(self.seen.follow(new.services))  # last: one of them may fail
        log.info("config_applied services=%d", len(new.services))

    def _follow(self) -> None:
        membership = self.following.look()
        if membership is not None:
            self.proxy.follow(membership)

    def _credentials_left_s(self) -> float | None:
        """Return how long the local manager's cloud credentials are valid; None if unknown."""
        told: Any = None
        with contextlib.suppress(FogftError):
            told = disk.read_json(self.config.lock.parent / "status.json")
        ends_at = told.get("credentials_end_at") if isinstance(told, dict) else None
        return ends_at - time.time() if isinstance(ends_at, (int, float)) else None

    def _report(self, told: Mapping[str, Any], now: float) -> None:
        seen = {**self.proxy.report(), **self.following.report(self.dialer.newer())}
        self.seen.diagnose(lambda: {**seen, "credentials_left_s": self._credentials_left_s()}, now)
        report = {
            "pid": os.getpid(),
            "written_at": time.time(),
            "robot": self.config.robot,
            "version": __version__,
            **told,
            **seen,
            "callers": self.callers(),
        }
        self.told.write(report)


_troubles: dict[Path, str] = {}


def try_step(step: Callable[[], None], path: Path) -> bool:
    """Run a step, log an error such as a full disk once; return whether the step succeeded."""
    try:
        step()
    except (FogftError, OSError) as error:  # OSError: no file descriptor, no folder
        reason = error.message if isinstance(error, FogftError) else str(error)
        if _troubles.get(path) != reason:
            _troubles[path] = reason
            log.error("file_failed path=%s reason=%r", path, reason)
        return False
    _troubles.pop(path, None)
    return True


def _same(old: ClientProxyConfig, new: ClientProxyConfig, path: Path) -> ClientProxyConfig:
    """Return the new configuration. Raises StateError if this process cannot apply it."""
    if (new.pool_uid, new.domain_id, new.rmw) != (old.pool_uid, old.domain_id, old.rmw):
        raise StateError(
            f"`{path}`: pool_uid, domain_id and rmw cannot change while the proxy runs"
        )
    return new


def _bury(config: ClientProxyConfig) -> None:
    """Tell ROS that the previous holder of the lock is gone: if killed, it could not do so."""
    with contextlib.suppress(StateError, ValueError):  # from reading and parsing the file
        left = disk.read_json(config.status)
        if isinstance(left, dict) and isinstance(said := left.get("participant"), str):
            domain = own_domain() if config.domain_id is None else config.domain_id
            spdp.declare_gone(bytes.fromhex(said), domain)


def _trace(path: Path, proxy: ClientProxy, spans: Spans | None) -> None:
    """Append request outcomes as JSON lines, keeping one older file, or export them as spans."""
    lines = proxy.trace()
    if not lines:
        return
    if spans is not None:
        spans.asked(lines)
        return
    try:
        if path.exists() and path.stat().st_size > _TRACE_BYTES:
            path.replace(path.with_name(path.name + ".1"))
        with path.open("a") as file:
            file.writelines(json.dumps(line) + "\n" for line in lines)
    except OSError as error:
        raise StateError(f"`{path}` cannot be written: {error.strerror}") from error


def _node_name(prefix: str, pool: str) -> str:
    return f"{prefix}_{pool.replace('-', '_')}"
