"""Preemption notices of different clouds, read into one form. Pure. By the clouds' own pages.

| cloud | what is asked | how long before |
|---|---|---|
| AWS | ``spot/instance-action``, ``events/recommendations/rebalance`` | 2 min; earlier, or not |
| GCP | ``instance/preempted`` | 30 s at most |
| Azure | ``scheduledevents``, of type ``Preempt`` or ``Terminate`` | 30 s at least |
"""

import json
from dataclasses import dataclass
from datetime import datetime, timezone
from email.utils import parsedate_to_datetime
from enum import Enum
from typing import Any


class NoticeKind(str, Enum):
    """The kinds of notices."""

    REBALANCE = "rebalance"  # a hint: it is more likely than before to be taken
    PREEMPTION = "preemption"  # it will be taken


@dataclass(frozen=True)
class Notice:
    """A notice that a machine may be preempted, or will be."""

    kind: NoticeKind
    at: float | None  # when it ends, in seconds since the epoch; None when that was not said
    source: str  # who said so: ``aws``, ``gcp``, ``azure``, ``file`` or ``signal``
    detail: str = ""  # the words, for the log


def aws_action(body: str) -> Notice | None:
    """Read ``spot/instance-action``: that it exists is the news, whether or not it can be read."""
    value = _map(body)
    action = value.get("action", "unknown")
    if action == "none":
        return None
    at = moment(value.get("time"))
    return Notice(NoticeKind.PREEMPTION, at, "aws", f"spot instance action: {action}")


def aws_rebalance(body: str) -> Notice | None:
    """Read ``events/recommendations/rebalance``. Its time is that of the notice, not of an end."""
    value = _map(body)
    if "noticeTime" not in value:
        return None
    return Notice(NoticeKind.REBALANCE, None, "aws", f"rebalance, {value['noticeTime']}")


def gcp_preempted(body: str) -> Notice | None:
    """Read ``instance/preempted``: ``TRUE`` or ``FALSE``."""
    if body.strip().upper() != "TRUE":
        return None
    return Notice(NoticeKind.PREEMPTION, None, "gcp", "instance preempted")


def azure_events(body: str, machine: str) -> Notice | None:
    """Read ``scheduledevents``: the events of all machines of a group, of which one is ours."""
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
    """Read a notice file: ``{"action": "terminate" | "rebalance", "at": s}``; it may be empty."""
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
    """Return a time of AWS's in seconds since the epoch; None for what is none."""
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
