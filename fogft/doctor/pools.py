"""Checks of a pool file, of the pools on this machine, and of leftovers of lost pools."""

import contextlib
import shlex
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path

from fogft import disk
from fogft.cloud.local import faults
from fogft.cloud.local.processes import find
from fogft.doctor.finding import Finding, Situation, fail, ok, warn
from fogft.errors import CredentialError, FogftError, StateError
from fogft.model.choices import Speaks
from fogft.model.groups import FIRST_BY_HAND
from fogft.model.plain import utc
from fogft.model.replica import LinkState, Phase
from fogft.pool.commands import status
from fogft.pool.commands.status import Seen
from fogft.pool.credentials import authority
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import read_identity
from fogft.pool.manager.proxy_report import STALE_S
from fogft.records.expiry import SOON

_UP = "`fogft up FILE`"


def orphaned_processes(situation: Situation) -> Iterator[Finding]:
    """No replica of the local cloud runs without its pool."""
    uids = []
    for pool in situation.pools:
        with contextlib.suppress(FogftError):
            uids.append(read_identity(PoolPaths.of(pool, situation.home)).uid)
    owned = {pid for uid in uids for pid in find(pool_uid=uid)}
    orphans = [pid for pid in find() if pid not in owned]
    if not orphans:
        yield ok("leftovers", "no replicas without a pool")
        return
    yield warn(
        "leftovers",
        f"{len(orphans)} replica processes belong to no pool in `{situation.home}`",
        "their pool is in another state folder: set FOGFT_HOME to it and run `fogft down`. "
        "If that folder is lost, they exit after `unmanaged_max_hours`",
    )


def chaos(situation: Situation) -> Iterator[Finding]:
    """No faults injected by `fogft chaos` are active."""
    broken = faults.read_cloud(situation.home / "local")
    found = [f"outage in `{place}`" for place in broken.out(situation.now)]
    found += [
        f"`{place}` has room for {n} machines" for place, n in sorted(broken.capacity.items())
    ]
    if found:
        yield warn(
            "leftovers",
            f"faults of `fogft chaos` are still active, for every pool: {', '.join(found)}",
            "clear them with `fogft chaos clear`",
        )


def pool_file(situation: Situation) -> Iterator[Finding]:
    """The types of a pool file's services can be loaded here."""
    if situation.spec is None:
        return
    from fogft.ros.types import load_service_type, trouble

    for service in situation.spec.services:
        if situation.spec.rmw.robot is Speaks.ZENOH and not service.needs_type:
            yield ok(
                "pool file", f"service `{service.name}` is forwarded without checking its type"
            )
            continue
        problem = trouble(load_service_type, service.type)
        if problem:
            yield fail(
                "pool file",
                f"service `{service.name}`: {problem.message}",
                problem.hint or "install the package of that type, or source its workspace",
            )
        else:
            yield ok("pool file", f"service `{service.name}` of type `{service.type}`")


def certificates(situation: Situation) -> Iterator[Finding]:
    """Certificates outlast a month, and all keys are private."""
    now = datetime.fromtimestamp(situation.now, timezone.utc)
    for pool in situation.pools:
        folder = PoolPaths.of(pool, situation.home).credentials
        if not folder.is_dir():
            yield warn(
                "credentials",
                f"pool `{pool}` has none yet",
                "the manager creates them; see `fogft logs`",
            )
            continue
        anew = f"run `fogft down {pool}` and `fogft up` again: that creates new ones"
        problems = list(judge_folder(f"pool `{pool}`", folder, now, anew))
        yield from problems
        if not problems:
            count = len(list(folder.rglob("*.crt")))
            yield ok("credentials", f"pool `{pool}`: {count} certificates valid, keys private")
    for folder in sorted((situation.home / "joined").glob("*.*.*")):
        pool, role, name = folder.name.split(".", 2)
        issue = f"`fogft credentials issue {role} {name}`"
        anew = f"join anew with a bundle of {issue}, or remove the folder if the pool is gone"
        yield from judge_folder(f"`{folder}`", folder, now, anew)


def judge_folder(whose: str, folder: Path, now: datetime, anew: str) -> Iterator[Finding]:
    """Judge the keys and certificates in a folder; yield nothing when all is well."""
    for key in sorted(folder.rglob("*.key")):
        if key.stat().st_mode & 0o077:
            yield fail(
                "credentials",
                f"{whose}: `{key}` can be read by other users",
                f"run `chmod 600 {key}`",
            )
    for certificate in sorted(folder.rglob("*.crt")):
        try:
            said = authority.describe(certificate)
        except CredentialError as error:
            yield fail("credentials", f"{whose}: {error.message}", anew)
            continue
        problem = said.problem(now)
        if problem:
            yield fail(
                "credentials",
                f"{whose}: `{certificate.name}` ({said.common_name}) is {problem}",
                f"is this machine's clock right (see `clock`)? If so, {anew}",
            )
        elif said.not_after - now < SOON:
            yield warn(
                "credentials",
                f"{whose}: `{certificate.name}` expires at {utc(said.not_after.timestamp())}",
                anew,
            )


def processes(situation: Situation) -> Iterator[Finding]:
    """Every pool has a manager and a client proxy whose links are up, and would answer now."""
    for pool in situation.pools:
        try:
            seen = status.read(PoolPaths.of(pool, situation.home), situation.now)
        except StateError as error:
            yield fail("manager", f"pool `{pool}`: {error.message}", error.hint or f"run {_UP}")
            continue
        if seen.status.ended and not seen.manager_alive:
            yield ok("manager", f"pool `{pool}`: ended {seen.status.ended}")
            continue
        yield from _judge_processes(pool, seen)
        yield from judge_traffic(pool, seen)
        folder = PoolPaths.of(pool, situation.home).folder
        if why := disk.unwritable(folder):
            remedy = "fix that: until then the manager launches nothing; it resumes by itself"
            yield fail("disk", f"pool `{pool}`: the disk of `{folder}` is {why}", remedy)
        else:  # not before: the disk is why the links' report is old
            yield from judge_links(pool, seen)


def _judge_processes(pool: str, seen: Seen) -> Iterator[Finding]:
    proxy, up = seen.status.proxy_alive, f"run `fogft up {shlex.quote(seen.status.file)}`"
    if seen.manager_alive:
        yield ok("manager", f"pool `{pool}`: runs")
    else:
        goes_on = "requests continue, but lost replicas are not replaced"
        what = goes_on if seen.answers else "nothing is replaced or started"
        yield warn("manager", f"pool `{pool}` has none: {what}", f"{up}, or `fogft down {pool}`")
    if proxy:
        yield ok("client proxy", f"pool `{pool}`: runs")
    else:
        log = PoolPaths.of(pool).proxy_log.name
        remedy = f"the manager restarts it; see `{log}`" if seen.manager_alive else up
        yield fail("client proxy", f"pool `{pool}` has none: no request is answered", remedy)
    if seen.answers:
        yield ok("answers", f"pool `{pool}`: every service has a ready replica")
    elif seen.answers is None and not seen.links_known:
        yield warn("answers", f"pool `{pool}`: unknown", "see `links` and `client proxy`")
    elif seen.answers is False and proxy and seen.status.target:
        listed = ", ".join(f"`{name}`" for name in seen.unanswered)
        yield fail("answers", f"pool `{pool}`: no replica answers {listed}", "see `fogft status`")


def judge_traffic(pool: str, seen: Seen) -> Iterator[Finding]:
    """Report clients that get no answers, and topics whose messages do not arrive."""
    for service in seen.status.services:
        if why := service.counters.get("trouble"):
            yield fail("services", f"pool `{pool}`: {why}", "")  # it says itself what to do
    for topic in seen.status.topics:
        if topic.counters.trouble:
            yield fail("topics", f"pool `{pool}`: {topic.counters.trouble}", "see `fogft status`")
        elif not topic.heard_by and seen.answers:
            yield warn(
                "topics",
                f"pool `{pool}`: `{topic.name}` has no subscriber with compatible QoS on a replica",
                "compare its `name`, `reliable` and `latched` with what the nodes there ask for",
            )


def judge_links(pool: str, seen: Seen) -> Iterator[Finding]:
    """Judge the links that a pool's client proxy reports."""
    status = seen.status
    if not status.proxy_alive:
        return
    if not seen.links_known:
        age_s, pid = seen.report_age_s, status.proxy_pid
        if age_s is not None and age_s < STALE_S:
            yield fail(
                "links",
                f"pool `{pool}`: its client proxy ended {age_s:.0f} s ago; the next one starts",
                "run `fogft doctor` again in a second",
            )
            return
        said = "has written no readable report" if pid is None else f"last did {age_s:.0f} s ago"
        yield fail(
            "links",
            f"pool `{pool}`: its client proxy should report twice a second, but {said}",
            f"it hangs or is stopped; kill process {pid}: the manager, or {_UP}, starts another"
            if pid
            else f"see `{PoolPaths.of(pool).proxy_log}`",
        )
        return
    reported = [one for one in (*status.replicas, *status.by_hand) if one.link]
    up = [one for one in reported if one.link == LinkState.UP.value]
    for one in reported:
        replica = f"pool `{pool}`: replica `{one.slot}.{one.generation}`"
        by_hand = one.slot >= FIRST_BY_HAND
        log = "the log on its machine" if by_hand else f"`fogft logs {one.slot}`"
        if one not in up:
            yield warn(
                "links",
                f"{replica} is {one.link}: {one.detail or 'it does not answer probes'}",
                f"it was started by hand and is not replaced automatically; see {log}"
                if by_hand
                else f"it is replaced if it stays silent; see `fogft status` and {log}",
            )
        elif one.detail and one.phase in (Phase.READY.value, Phase.DRAINING.value):
            yield warn("replicas", f"{replica}: {one.detail}", "it is used all the same")
        elif one.detail:
            yield warn(
                "replicas",
                f"{replica} is not ready: {one.detail}",
                f"{log} shows what `run` prints; compare each `name` and "
                "`type` in the pool file with what the node offers",
            )
    if reported and not up:
        yield fail(
            "links",
            f"pool `{pool}`: no link is up",
            "check this machine's own network first: all links went silent together",
        )
    elif up:
        yield ok("links", f"pool `{pool}`: {len(up)} of {len(reported)} up")
