"""Launch actions for nodes in the cloud: `FogPool` and `CloudNode`, in Python, XML and YAML.

Needs ROS 2's `launch` and `launch_ros`, which are imported when a name is first used.
Not here: starting and ending a pool (`fogft.pool.commands`).
"""

from typing import Any

__all__ = ["CloudNode", "FogPool"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module `{__name__}` has no attribute `{name}`")
    from fogft.launch import actions

    return getattr(actions, name)
