"""How long each step of a proof took, and how much of it was fogft's own.

Not fogft's: SkyPilot's API server starting, its requests that fogft waits for (check, launch, down,
refresh), and on a VM all until the pool file's `setup` has run, since SkyPilot and Ray get there.
Fogft's: the rest, its own import of SkyPilot, its installation on the VM and the service's start
included. Where two things went on at once, a moment counts as SkyPilot's.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.sky.emulated_aws.emulation import disk_of, running

Span = tuple[float, float]
WAITED_FOR = ("sky.check", "sky.launch", "sky.down", "sky.api_cancel")
_EVENT = re.compile(r"(\S+) \w+ (\w+) (.*)")


@dataclass
class Machines:
    """When each VM was ready for fogft; their disks vanish with them, so look early."""

    set_up: dict[str, float] = field(default_factory=dict)

    def look(self) -> None:
        """Note those that are new."""
        for instance in running():
            labels = instance["labels"]
            name = (
                f"fogft-{labels['fogft-pool']}-{labels['fogft-slot']}-{labels['fogft-generation']}"
            )
            ran = disk_of(instance) / "home/ubuntu/setup-ran"
            if ran.exists():
                self.set_up.setdefault(name, ran.stat().st_mtime)


def skypilots(machines: Machines) -> list[Span]:
    """Return when SkyPilot, or a VM on behalf of it, was at work for somebody who waited."""
    from sky.client import sdk

    requests = sdk.api_status(all_status=True)
    spans: list[Span] = [(_server_started_at(), min(r.created_at for r in requests))]
    spans += [
        (r.created_at, r.finished_at)
        for r in requests
        if r.finished_at and (r.name in WAITED_FOR or _refreshes(r))
    ]
    for request in requests:
        ready_at = machines.set_up.get(request.cluster_name or "")
        if request.name == "sky.launch" and ready_at:
            spans.append((request.created_at, ready_at))
    return spans


def _refreshes(request: Any) -> bool:
    return request.name == "sky.status" and "FORCE" in str(request.request_body)


def _server_started_at() -> float:
    import psutil

    servers = [
        process.create_time()
        for process in psutil.process_iter(["cmdline"])
        if "sky.server.server" in (process.info["cmdline"] or ())
    ]
    return min(servers)


def shared(span: Span, others: Iterable[Span]) -> float:
    """Return for how long of a span at least one of the others was on."""
    cut = sorted((max(a, span[0]), min(b, span[1])) for a, b in others)
    total, reached = 0.0, span[0]
    for a, b in cut:
        total += max(0.0, b - max(a, reached))
        reached = max(reached, b)
    return total


def table(steps: Sequence[tuple[str, float, float]], sky: Sequence[Span]) -> str:
    """Return the table: seconds in all, of SkyPilot and the cloud, of fogft."""
    lines = ["   all  SkyPilot  fogft  seconds"]
    total = own = 0.0
    for name, begun_at, ended_at in steps:
        seconds = ended_at - begun_at
        theirs = shared((begun_at, ended_at), sky)
        total, own = total + seconds, own + seconds - theirs
        lines.append(f"{seconds:6.1f}  {theirs:8.1f}  {seconds - theirs:5.1f}  {name}")
    lines.append(f"{total:6.1f}  {total - own:8.1f}  {own:5.1f}  together")
    return "\n".join(lines) + "\n"


def events(log: Path) -> list[tuple[float, str, str]]:
    """Return the events of the manager's log: when, which, and what it says of them."""
    found = []
    for line in log.read_text().splitlines():
        match = _EVENT.match(line)
        if match:
            at = datetime.datetime.fromisoformat(match[1]).timestamp()
            found.append((at, match[2], match[3]))
    return found


def reaction(
    log: Sequence[tuple[float, str, str]], since: float, steps: Iterable[tuple[str, str]]
) -> list[tuple[str, float]]:
    """Return how long after `since`, then after each other, events came. Those that did not, miss.

    Args:
        log: The manager's events.
        since: When it began.
        steps: Of each event its name, and what its line has.
    """
    out = []
    for name, having in steps:
        found = (at for at, event, text in log if at >= since and event == name and having in text)
        at = next(found, None)
        if at is not None:
            out.append((name, at - since))
            since = at
    return out
