"""Import what runs on every VM, so that it is compiled in the image already.

By hand and not by `compileall`: SkyPilot and Ray have ten times as many modules as are used.
"""

import contextlib
import importlib
import pkgutil

USED = (
    "sky.skylet.skylet",
    "sky.skylet.autostop_lib",
    "sky.skylet.job_lib",
    "sky.skylet.log_lib",
    "sky.skylet.ray_patches",
    "sky.skylet.subprocess_daemon",
    "sky.provision.aws",
    "ray.scripts.scripts",
    "ray.job_submission",
    "ray.dashboard.dashboard",
    "ray.dashboard.agent",
    "ray._private.log_monitor",
    "ray._private.services",
    "ray._private.runtime_env.agent.main",
    "ray.autoscaler._private.monitor",
)


def use(name: str) -> None:
    with contextlib.suppress(Exception):  # what does not import here is compiled on the VM
        importlib.import_module(name)


for name in USED:
    use(name)
modules = importlib.import_module("ray.dashboard.modules")
for found in pkgutil.walk_packages(modules.__path__, "ray.dashboard.modules.", onerror=print):
    use(found.name)
