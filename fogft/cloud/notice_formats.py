"""Parse the preemption notices of each cloud into one form, by the clouds' documentation. Pure.

| cloud | metadata path | time until preemption |
|---|---|---|
| AWS | ``spot/instance-action``, ``events/recommendations/rebalance`` | 2 min; earlier or never |
| GCP | ``instance/preempted`` | 30 s at most |
| Azure | ``scheduledevents``, of type ``Preempt`` or ``Terminate`` | 30 s at least |
"""

import json
from datetime import datetime, timezone
from email.utils import parsedate_to_datetime
from enum import Enum
from typing import Any, NamedTuple


class NoticeKind(str, Enum):
    """The kind of a notice."""

    REBALANCE = "rebalance"  # a hint: preemption has become more likely
    PREEMPTION = "preemption"  # the machine will be preempted


class Notice(NamedTuple):
    """A notice that a machine may be preempted, or will be."""

    kind: NoticeKind
    at: float | None  # when the machine ends, in seconds since the epoch; None if not given
    source: str  # who sent it: ``aws``, ``gcp``, ``azure``, ``file`` or ``signal``
    detail: str = ""  # human-readable, for the log


def aws_action(body: str) -> Notice | None:
    """Parse ``spot/instance-action``. Its existence is the notice, even if it cannot be parsed."""
    value = _map(body)
    action = value.get("action", "unknown")
    if action == "none":
        return None
    at = moment(value.get("time"))
    return Notice(NoticeKind.PREEMPTION, at, "aws", f"spot instance action: {action}")


def aws_rebalance(body: str) -> Notice | None:
    """Parse ``events/recommendations/rebalance``. Its time is that of the notice, not of an end."""
    value = _map(body)
    if "noticeTime" not in value:
        return None
    return Notice(NoticeKind.REBALANCE, None, "aws", f"rebalance, {value['noticeTime']}")


def gcp_preempted(body: str) -> Notice | None:
    """Parse ``instance/preempted``: ``TRUE`` or ``FALSE``."""
    if body.strip().upper() != "TRUE":
        return None
    return Notice(NoticeKind.PREEMPTION, None, "gcp", "instance preempted")


def azure_events(body: str, machine: str) -> Notice | None:
    """Parse ``scheduledevents``: the events of all VMs in a group; `machine` is our VM's name."""
    events = _map(body).get("Events")
    for event in events if isinstance(events, list) else ():
        if not isinstance(event, dict) or event.get("EventType") not in ("Preempt", "Terminate"):
            continue
        if event.get("EventStatus") in ("Completed", "Canceled"):
            continue
        if machine not in (event.get("Resources") or [machine]):
            continue
        at = _http_date(event.get("NotBefore"))
        return Notice(NoticeKind.PREEMPTION, at, "azure", f"scheduled {event['EventType']}")
    return None


def file_notice(content: str) -> Notice:
    """Parse a notice file: ``{"action": "terminate" | "rebalance", "at": s}``; it may be empty."""
    value = _map(content)
    at = value.get("at")
    kind = NoticeKind.REBALANCE if value.get("action") == "rebalance" else NoticeKind.PREEMPTION
    return Notice(kind, float(at) if isinstance(at, (int, float)) else None, "file")


def _map(body: str) -> dict[str, Any]:
    try:
        value = json.loads(body)
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}


def moment(text: Any) -> float | None:
    """Return an AWS timestamp in seconds since the epoch; None if it is not a timestamp."""
    try:
        read = datetime.fromisoformat(str(text).replace("UTC", "+00:00").replace("Z", "+00:00"))
    except ValueError:
        return None
    return (read if read.tzinfo else read.replace(tzinfo=timezone.utc)).timestamp()


def _http_date(text: Any) -> float | None:
    try:
        return parsedate_to_datetime(str(text)).timestamp()
    except (ValueError, TypeError, IndexError):
        return None
