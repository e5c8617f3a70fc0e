"""The status of a pool now, each part from its best source: docs/design/command-line.md.

What was not observed recently is shown as unknown, never by its last value.

Not here: its schema (`fogft.pool.manager.status`), showing it (`fogft.cli`).
"""

import contextlib
import os
import time
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import Any

from fogft import disk
from fogft.errors import StateError
from fogft.model.plain import to_plain
from fogft.model.reason import Reason
from fogft.model.replica import LinkReport, LinkState
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.manager import proxy_report, status
from fogft.pool.manager.proxy_report import ProxyReport
from fogft.pool.manager.status import PoolStatus

_LOOK_EVERY_S = 0.05
STALE_AFTER_S = 15.0
"""An older observation of the manager says nothing about the present."""


@dataclass(frozen=True)
class Seen:
    """A status with its age and the processes that are alive.

    Attributes:
        age_s: Time since the manager observed the pool; None if it has not yet.
        report_age_s: Time since the client proxy reported its links; None for no report.
        links_known: Whether that report is recent, and the client proxy runs now.
        answers: Whether a request to each service would be answered now; None for unknown.
        unanswered: The services whose requests would not be answered.
    """

    status: PoolStatus
    age_s: float | None
    manager_alive: bool
    report_age_s: float | None = None
    links_known: bool = True
    answers: bool | None = None
    unanswered: Sequence[str] = ()

    @property
    def lease_left_s(self) -> float | None:
        """Seconds until the first replica shuts down without a manager; None if unknown."""
        rows = (*self.status.replicas, *self.status.by_hand)
        known = [one.lease_left_s for one in rows if one.lease_left_s is not None]
        return min(known, default=None)

    @property
    def stale(self) -> bool:
        """Whether the manager's last observation is too old."""
        return self.age_s is None or self.age_s > STALE_AFTER_S

    def to_json(self) -> dict[str, Any]:
        """Return the JSON form: that of `status.json` with the keys added here."""
        own = {name: value for name, value in vars(self).items() if name != "status"}
        return {**to_plain(self.status), **own, "unanswered": list(self.unanswered)}


def current(
    status: PoolStatus,
    report: ProxyReport | None,
    *,
    manager_alive: bool,
    proxy_alive: bool,
    now: float,
    succeeded: bool = False,
    heard_since: float | None = None,
) -> Seen:
    """Return the status now.

    Args:
        succeeded: The proxy that wrote the report has ended, and another one runs.
        heard_since: Only a link whose replica has answered a probe since then counts as up;
            None to count links as reported.
    """
    is_fresh = report is not None and report.fresh(now) and proxy_alive and not succeeded
    fresh = report if is_fresh else None
    links = fresh.links if fresh is not None else None
    if fresh is not None and heard_since is not None:
        links = tuple(_heard(k, fresh.written_at, heard_since) for k in fresh.links)
    age_s = abs(now - status.observed_at) if status.observed_at else None
    seen = Seen(
        status,
        age_s,
        manager_alive,
        None if report is None else max(0.0, now - report.written_at),
        links_known=fresh is not None,
    )
    found = status.joined(report, proxy_alive=proxy_alive, links=links, stale=seen.stale)
    found = replace(found, uplink_suspected=fresh is not None and fresh.uplink_suspected)
    services = found.services
    silent = [one.name for one in services if not one.answers]
    hangs = proxy_alive and fresh is None
    answers = None if hangs or not services else proxy_alive and not silent
    return replace(seen, status=found, answers=answers, unanswered=() if hangs else silent)


def _heard(link: LinkReport, written_at: float, since: float) -> LinkReport:
    heard_at = -1.0 if link.heard_age_s is None else written_at - link.heard_age_s
    if link.state is LinkState.UP and heard_at < since:
        return replace(link, state=LinkState.SUSPECT, detail="it did not answer a probe in time")
    return link


def read(paths: PoolPaths, now: float, *, heard_since: float | None = None) -> Seen:
    """Return the status of a pool now; `heard_since` as in `current`."""
    raw = disk.read_json(paths.status)
    seen = _unobserved(paths) if raw is None else status.from_json(raw, paths.status)
    report = proxy_report.read(paths.proxy_status, seen.uid)
    return current(
        seen,
        report,
        manager_alive=disk.is_locked(paths.manager_lock),
        proxy_alive=disk.is_locked(paths.proxy_lock),
        succeeded=report is not None and _has_successor(report.pid, paths.proxy_lock),
        now=now,
        heard_since=heard_since,
    )


def _has_successor(pid: int, lock: Path) -> bool:
    """Whether a process has ended, or is a zombie, and another one claims to hold its lock.

    A process that hands over lives on for a while. In a container, the lock's file has another pid.
    """
    said = disk.said_holder(lock)
    return said not in (None, pid) and not disk.is_running(pid)


def checked(paths: PoolPaths, limit_s: float) -> Seen:
    """Wait until each link has answered a new probe, and return the status then.

    The client proxy probes all links by itself, at least once a second; a link that has not had
    an answer within `limit_s` counts as suspect.
    """
    asked_at, deadline = time.time(), time.monotonic() + limit_s
    while True:
        seen = read(paths, time.time())
        asked = read(paths, time.time(), heard_since=asked_at)
        links = [(*one.status.replicas, *one.status.by_hand) for one in (seen, asked)]
        if not seen.status.proxy_alive or time.monotonic() >= deadline:
            return asked
        if seen.links_known and [r.link for r in links[0]] == [r.link for r in links[1]]:
            return asked
        time.sleep(_LOOK_EVERY_S)


def renewed(paths: PoolPaths, limit_s: float = 15.0) -> Seen:
    """Make the manager observe the pool again; return the status (without a manager, the last)."""
    asked_at = time.time()
    deadline = time.monotonic() + limit_s
    with contextlib.suppress(OSError):
        os.utime(paths.intent)  # the manager watches it
    while True:
        seen = read(paths, time.time())
        if not seen.manager_alive or seen.status.observed_at >= asked_at:
            return seen
        if time.monotonic() >= deadline:
            raise StateError(
                f"the manager of `{seen.status.pool}` did not refresh within {limit_s:.0f} s",
                "see `fogft logs`; `fogft status` shows what it saw last",
            )
        time.sleep(_LOOK_EVERY_S)


def slots(paths: PoolPaths) -> list[int]:
    """Return the slots that hold a replica, sorted."""
    return sorted({replica.slot for replica in read(paths, time.time()).status.replicas})


def _unobserved(paths: PoolPaths) -> PoolStatus:
    """Return the status of a pool that its manager has not observed yet."""
    from fogft.pool.folder.store import read_identity

    identity = read_identity(paths)
    return PoolStatus(identity.name, identity.uid, identity.cloud, identity.file)


_PLAIN = {str: "string", int: "integer", float: "number", bool: "boolean", NoneType: "null"}


def status_schema() -> dict[str, Any]:
    """Return the JSON schema of `fogft status --json`."""
    definitions: dict[str, Any] = {}
    own = _object(PoolStatus, definitions)
    of_reader = _object(Seen, definitions)
    properties = {**own["properties"], **of_reader["properties"]}
    del properties["status"], definitions["PoolStatus"]  # its keys are at the top level
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "fogft status --json",
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "$defs": definitions,
    }


def _object(cls: type[Any], definitions: dict[str, Any]) -> dict[str, Any]:
    hints = typing.get_type_hints(cls)
    # A reason has only the keys that belong to its cause; everything else has all of its keys.
    required = ["cause"] if cls is Reason else [field.name for field in fields(cls)]
    properties = {}
    for field in fields(cls):
        properties[field.name] = _form(hints[field.name], definitions)
        words = field.metadata.get("words")
        if words is not None:
            properties[field.name]["enum"] = list(words)
    return {"type": "object", "properties": properties, "required": required}


def _form(hint: Any, definitions: dict[str, Any]) -> dict[str, Any]:
    if hint in _PLAIN:
        return {"type": _PLAIN[hint]}
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, UnionType):
        return {"anyOf": [_form(one, definitions) for one in arguments]}
    if origin in (Sequence, tuple):
        return {"type": "array", "items": _form(arguments[0], definitions)}
    if origin is Mapping:
        return {"type": "object"}
    if isinstance(hint, type) and issubclass(hint, Enum):
        return {"type": "string", "examples": [one.value for one in hint]}
    if isinstance(hint, type) and is_dataclass(hint):
        name = hint.__name__
        if name not in definitions:
            definitions[name] = {}  # reserved, for types that contain themselves
            definitions[name] = _object(hint, definitions)
        return {"$ref": f"#/$defs/{name}"}
    raise TypeError(f"`{hint}` has no JSON form")
