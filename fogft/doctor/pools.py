"""Checks of a pool file and of the pools on this machine: credentials, manager, proxy, links."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from datetime import datetime, timedelta, timezone
from functools import partial
from pathlib import Path

from fogft import disk
from fogft.doctor.finding import Check, Finding, Situation, fail, ok, warn
from fogft.errors import CredentialError, FogftError
from fogft.model.choices import Speaks
from fogft.model.groups import FIRST_BY_HAND
from fogft.model.replica import LinkReport, LinkState
from fogft.pool.credentials import authority
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import read_identity
from fogft.pool.manager import proxy_report

_EXPIRY_WARNING = timedelta(days=3)
# The client proxy reports twice a second.
_REPORT_LIMIT_S = 10.0


def pool_file(situation: Situation) -> Iterator[Finding]:
    """The types of a pool file's services can be loaded here."""
    if situation.spec is None:
        return
    from fogft.ros.types import load_service_type, trouble

    for service in situation.spec.services:
        if situation.spec.rmw.robot is Speaks.ZENOH and not service.needs_type:
            yield ok("pool file", f"service `{service.name}` passes through, of whatever type")
            continue
        problem = trouble(partial(load_service_type, service.type))
        if problem:
            yield fail(
                "pool file",
                f"service `{service.name}`: {problem}",
                "install the package of that type, or source its workspace",
            )
        else:
            yield ok("pool file", f"service `{service.name}` of type `{service.type}`")


def certificates(situation: Situation) -> Iterator[Finding]:
    """Every pool's certificates are valid now, its keys private."""
    now = datetime.fromtimestamp(situation.now, timezone.utc)
    for pool in situation.pools:
        folder = PoolPaths.of(pool, situation.home).credentials
        if not folder.is_dir():
            yield warn(
                "credentials",
                f"pool `{pool}` has none yet",
                "its manager makes them; see `fogft logs`",
            )
            continue
        problems = list(judge_folder(pool, folder, now))
        yield from problems
        if not problems:
            count = len(list(folder.rglob("*.crt")))
            yield ok("credentials", f"pool `{pool}`: {count} certificates valid, keys private")


def judge_folder(pool: str, folder: Path, now: datetime) -> Iterator[Finding]:
    """Judge the keys and certificates in a folder; yield nothing when all is well."""
    for key in sorted(folder.rglob("*.key")):
        if key.stat().st_mode & 0o077:
            yield fail(
                "credentials",
                f"pool `{pool}`: `{key}` can be read by other users",
                f"run `chmod 600 {key}`",
            )
    anew = f"run `fogft down {pool}` and `fogft up` again: that makes new ones"
    for certificate in sorted(folder.rglob("*.crt")):
        try:
            said = authority.describe(certificate)
        except CredentialError as error:
            yield fail("credentials", f"pool `{pool}`: {error.message}", anew)
            continue
        problem = said.problem(now)
        if problem:
            yield fail(
                "credentials",
                f"pool `{pool}`: `{certificate.name}` ({said.common_name}) is {problem}",
                f"is this machine's clock right (see `clock`)? If so, {anew}",
            )
        elif said.not_after - now < _EXPIRY_WARNING:
            yield warn(
                "credentials",
                f"pool `{pool}`: `{certificate.name}` expires at "
                f"{said.not_after:%Y-%m-%d %H:%M} UTC",
                anew,
            )


def processes(situation: Situation) -> Iterator[Finding]:
    """Every pool has a manager and a client proxy."""
    for pool in situation.pools:
        paths = PoolPaths.of(pool, situation.home)
        ended = _ended(paths)
        if ended:
            yield ok("manager", f"pool `{pool}`: ended {ended}")
            continue
        if disk.is_locked(paths.manager_lock):
            yield ok("manager", f"pool `{pool}`: runs")
        else:
            yield warn(
                "manager",
                f"pool `{pool}` has none: requests continue, but lost replicas are not replaced",
                "start it with `fogft up FILE`, or end the pool with `fogft down`",
            )
        if disk.is_locked(paths.proxy_lock):
            yield ok("client proxy", f"pool `{pool}`: runs")
        else:
            yield fail(
                "client proxy",
                f"pool `{pool}` has none: no request is answered",
                f"its manager starts it; see `{paths.proxy_log}`",
            )


def _ended(paths: PoolPaths) -> str:
    """Return how a pool has ended by itself; empty when it has not."""
    if disk.is_locked(paths.manager_lock):
        return ""
    with contextlib.suppress(FogftError):
        status = disk.read_json(paths.status)
        return str(status.get("ended") or "") if isinstance(status, dict) else ""
    return ""


def links(situation: Situation) -> Iterator[Finding]:
    """Every link of a running client proxy is up and its replica ready."""
    for pool in situation.pools:
        paths = PoolPaths.of(pool, situation.home)
        if not disk.is_locked(paths.proxy_lock):
            continue
        report = proxy_report.read(paths.proxy_status, read_identity(paths).uid)
        age_s = situation.now - report.written_at if report else 0.0
        if report is None:
            yield fail(
                "links",
                f"pool `{pool}`: its client proxy has written no report that can be read",
                f"see `{paths.proxy_log}`",
            )
        elif age_s > _REPORT_LIMIT_S:
            yield fail(
                "links",
                f"pool `{pool}`: its client proxy last reported {age_s:.0f} s ago",
                f"it hangs or is stopped; end process {report.pid}: the manager starts another",
            )
        else:
            yield from judge_links(pool, report.links)


def judge_links(pool: str, reported: Sequence[LinkReport]) -> Iterator[Finding]:
    """Judge the links that a client proxy reports."""
    up = [link for link in reported if link.state is LinkState.UP]
    for link in reported:
        replica = f"pool `{pool}`: replica `{link.id.short}`"
        by_hand = link.id.slot >= FIRST_BY_HAND
        log = "the log on its machine" if by_hand else f"`fogft logs {link.id.slot}`"
        if link.state is not LinkState.UP:
            yield warn(
                "links",
                f"{replica} is {link.state.value}: {link.detail or 'it does not answer probes'}",
                f"it was started by hand, and nobody replaces it; see {log}"
                if by_hand
                else f"it is replaced if it stays silent; see `fogft status` and {log}",
            )
        elif link.detail:
            yield warn(
                "replicas",
                f"{replica} is not ready: {link.detail}",
                f"{log} shows what `run` says; is each `name` and `type` "
                "in the pool file what the node offers?",
            )
    if reported and not up:
        yield fail(
            "links",
            f"pool `{pool}`: no link is up",
            "check this machine's own network first: all links went silent together",
        )
    elif up:
        yield ok("links", f"pool `{pool}`: {len(up)} of {len(reported)} up")


CHECKS: tuple[Check, ...] = (pool_file, certificates, processes, links)
