"""The policy of docs/how-to/clouds.md, as the emulated AWS enforces it on whoever launches.

Judged are an action's name, of `CreateTags` what is tagged, and of what is about instances
whether these carry our label. The VMs have the role's: `ec2:Describe*`, and `TerminateInstances`
under the same condition. A test takes single permissions away.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parents[3] / "docs/how-to/clouds.md"
ANYBODY = ("sts:GetCallerIdentity",)  # needs no permission on AWS
_ACCOUNT = "arn:aws:ec2:us-east-1:ACCOUNT:"
_BESIDE_AN_INSTANCE = "arn:aws:ec2:*:ACCOUNT:security-group/*"
_CONDITION = {"Null": {"aws:ResourceTag/fogft-pool": "false"}}
OF_VMS: list[Mapping[str, Any]] = [
    {"Effect": "Allow", "Action": "ec2:Describe*", "Resource": "*"},
    {"Effect": "Allow", "Action": "ec2:TerminateInstances", "Resource": "*",
     "Condition": _CONDITION},
]  # fmt: skip


def statements(page: str) -> list[Mapping[str, Any]]:
    """Return the statements of the one policy on a page."""
    (found,) = re.findall(r'```json\n(\{\s*"Version".*?)```', page, re.DOTALL)
    return list(json.loads(found)["Statement"])


def actions(rules: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return all that rules allow: names, and patterns of names."""
    listed = (
        [rule["Action"]] if isinstance(rule["Action"], str) else rule["Action"] for rule in rules
    )
    return [action for one in listed for action in one]


class Policy:
    """What may be done. `taken` are actions, or patterns of them, that were taken away."""

    def __init__(self, rules: Iterable[Mapping[str, Any]]) -> None:
        self._rules = list(rules)
        self.taken: set[str] = set()

    def allows(
        self, action: str, tags: Callable[[], Iterable[Mapping[str, str]]], kind: str = ""
    ) -> bool:
        """Whether an action is allowed.

        Args:
            action: Its name.
            tags: Returns those of each instance that it is about.
            kind: What is tagged with `CreateTags`, such as `volume`.
        """
        if action in ANYBODY:
            return True
        if any(fnmatchcase(action, one) for one in self.taken):
            return False
        for rule in self._rules:
            if not any(fnmatchcase(action, one) for one in actions([rule])):
                continue
            tagged = f"{_ACCOUNT}{kind}/x"
            if kind and not any(fnmatchcase(tagged, one) for one in rule["Resource"]):
                continue
            if rule.get("Resource") == _BESIDE_AN_INSTANCE:
                continue  # another statement judges the instance
            condition = rule.get("Condition")
            if condition is None:
                return True
            if condition != _CONDITION:
                raise NotImplementedError(f"a condition that nobody judges: {condition}")
            if all("fogft-pool" in one for one in tags()):
                return True
        return False
