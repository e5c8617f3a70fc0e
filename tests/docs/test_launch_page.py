"""The page on launch files keeps its promise: few lines change."""

from __future__ import annotations

import difflib
from pathlib import Path

PAGE = (Path(__file__).parents[2] / "docs/how-to/launch-files.md").read_text()


def test_before_and_after_differ_in_at_most_five_lines() -> None:
    before, after = (part.split("```")[0].splitlines() for part in PAGE.split("```xml\n")[1:3])
    diff = [line for line in difflib.unified_diff(before, after, n=0) if line[:1] in "+-"][2:]
    changed = {line[1:].strip() for line in diff}
    assert sum(line[0] == "+" for line in diff) <= 5
    assert sum(line[0] == "-" for line in diff) <= 5
    assert (
        '<cloud_node pkg="planner" exec="plan_service" name="planner" namespace="/arm">' in changed
    )
