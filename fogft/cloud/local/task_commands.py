"""The environment in which a local machine runs a task's commands."""

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fogft.ros.environment import child_environment


def environment(task: Mapping[str, Any]) -> dict[str, str]:
    """Return the environment of `setup`: the user's own plus the task's variables."""
    environ = child_environment(os.environ)
    if sys.prefix != sys.base_prefix:
        environ["PATH"] = f"{sys.prefix}/bin:{environ.get('PATH', os.defpath)}"
    return environ | variables(task)


def server_environment(task: Mapping[str, Any], domain: int) -> dict[str, str]:
    """Return the server proxy's environment, including the service's `RMW_IMPLEMENTATION`."""
    given = variables(task)
    if "PYTHONPATH" in given and "PYTHONPATH" in os.environ:  # fogft may be installed there
        given["PYTHONPATH"] += os.pathsep + os.environ["PYTHONPATH"]
    return {**os.environ, **given, "ROS_DOMAIN_ID": str(domain)}


def variables(task: Mapping[str, Any]) -> dict[str, str]:
    """Return the variables in a task's `envs` and `secrets`."""
    found = {**(task.get("envs") or {}), **(task.get("secrets") or {})}
    return {str(k): "" if v is None else str(v) for k, v in found.items()}


def sourced(command: list[str], workdir: Path) -> list[str]:
    """Return a command that runs with the folder's colcon workspace sourced, if it has one."""
    setup = workdir / "install" / "setup.bash"
    if not setup.is_file():
        return command
    return ["bash", "-c", '. "$0"; exec "$@"', str(setup), *command]
