"""A `workdir` that is a colcon workspace, and the `setup` that builds it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fogft import template_files


def with_build(task: Mapping[str, Any]) -> dict[str, Any]:
    """Return a task that builds its workspace, where it has one and says nothing of `setup`.

    Raises:
        FogftError: The installation lacks its templates.
    """
    workdir = task.get("workdir")
    if task.get("setup") or not isinstance(workdir, str) or not is_workspace(Path(workdir)):
        return dict(task)
    return {**task, "setup": (template_files.folder() / "workspace.sh").read_text()}


def is_workspace(folder: Path) -> bool:
    """Whether there are packages below its `src`."""
    return next((folder / "src").rglob("package.xml"), None) is not None
