"""Merge the status lists that replicas publish of an action into one.

Owns: reading and writing them. Not here: which status counts (`fogft.topics.goals`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fogft.errors import Unreadable
from fogft.ros.messages import from_bytes, to_bytes
from fogft.topics import goals


def merged(said: Mapping[int, bytes]) -> bytes | None:
    """Return one `action_msgs/msg/GoalStatusArray` (CDR) of what replicas said last.

    None where a list cannot be read; what cannot be read comes from no action server.
    """
    from action_msgs.msg import GoalStatusArray

    entries: dict[bytes, Any] = {}
    statuses: dict[int, dict[bytes, int]] = {}
    try:
        for replica, message in said.items():
            listed = from_bytes(message, GoalStatusArray).status_list
            statuses[replica] = {bytes(one.goal_info.goal_id.uuid): one.status for one in listed}
            for one in listed:
                entries.setdefault(bytes(one.goal_info.goal_id.uuid), one)
    except Unreadable:
        return None
    found = GoalStatusArray()
    for goal, status in goals.merged(statuses).items():
        entries[goal].status = status
        found.status_list.append(entries[goal])
    return to_bytes(found)
