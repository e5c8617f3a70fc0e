"""Environment variables for ROS 2 processes, and what the current environment contains.

`prepare` must run before the first node is created, ideally before rclpy is imported.
User settings are never overridden; ``ROS_DOMAIN_ID``, ``ROS_LOCALHOST_ONLY`` and
``ROS_AUTOMATIC_DISCOVERY_RANGE`` are left to ROS itself.

Owns: the shared-memory profile's location, variables of ROS and of its Python wheels.
Not here: judging the findings (`fogft doctor`).
"""

import contextlib
import os
import re
import shutil
import sys
from collections.abc import Mapping, MutableMapping
from pathlib import Path

from fogft import template_files

# Fast DDS 3 (Kilted and later) reads the first, Fast DDS 2 (Jazzy, Humble) the second only. Setting
# both makes newer rmw_fastrtps warn. Libraries are named like their variable.
_PROFILE_VARIABLES = {
    "libfastdds.so": "FASTDDS_DEFAULT_PROFILES_FILE",
    "libfastrtps.so": "FASTRTPS_DEFAULT_PROFILES_FILE",
}
_CHOSEN_BY_USER = (*_PROFILE_VARIABLES.values(), "FASTDDS_BUILTIN_TRANSPORTS")
# A smaller segment, such as Fast DDS's own default, means that no profile is in force.
PROFILE_SEGMENT_BYTES = 32_000_000
_SEGMENT = re.compile(r"/dev/shm/fast(?:dds|rtps)_[0-9a-f]+\b")
# Each participant takes 35 MB for its segment: room for the two ends of a call, twice.
_ROOM_NEEDED_BYTES = 140_000_000
# Fast DDS reads these from the working folder if no variable names a file.
_LOCAL_PROFILES = ("DEFAULT_FASTDDS_PROFILES.xml", "DEFAULT_FASTRTPS_PROFILES.xml")

# The wheels' start-up hook re-executes Python once with another LD_LIBRARY_PATH and sets this
# variable. Inherited by a child in another environment, it would keep that one's hook from running.
_WHEELS_GUARD = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"

_DISTRIBUTIONS = {"3.3": "humble", "7.1": "jazzy", "9.1": "kilted"}  # by rclpy's version


def profile_path() -> Path:
    """Return the shipped Fast DDS profile. Raises FogftError: the installation is incomplete."""
    return template_files.folder() / "fastdds_shm.xml"


def profile_variable(environ: Mapping[str, str] = os.environ) -> str:
    """Return the variable from which the Fast DDS that will be loaded reads its profile.

    Checks which library is in the sourced ROS installation, else beside this Python, without
    importing rclpy. If there is none, returns the variable of the newest Fast DDS.
    """
    prefixes = [p for p in environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    for prefix in (*prefixes, sys.prefix):
        for library, variable in _PROFILE_VARIABLES.items():
            folder = Path(prefix, "lib")
            if (folder / library).exists() or any(folder.glob(f"*-linux-gnu/{library}")):
                return variable
    return "FASTDDS_DEFAULT_PROFILES_FILE"


def largest_segment_bytes() -> int:
    """Return the size of the largest Fast DDS segment that this process maps; 0 for none."""
    largest = 0
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/maps").read_text().splitlines():
            if _SEGMENT.search(line):
                first, _, last = line.split(" ", 1)[0].partition("-")
                largest = max(largest, int(last, 16) - int(first, 16))
    return largest


def prepare(environ: MutableMapping[str, str] = os.environ) -> bool:
    """Set the shared-memory profile unless the user has set one; return whether it did.

    It does not if /dev/shm is small, as in containers by default (64 MB): Fast DDS would
    report errors and fall back to UDP.

    Raises RosError: The installation is incomplete.
    """
    chosen = any(map(environ.get, _CHOSEN_BY_USER)) or any(
        Path(n).is_file() for n in _LOCAL_PROFILES
    )
    if chosen or _shared_memory_free_bytes() < _ROOM_NEEDED_BYTES:
        return False
    environ[profile_variable(environ)] = str(profile_path())
    return True


def child_environment(environ: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Return the environment for a user's command, in any Python installation.

    Undoes what the ROS wheels' start-up hook did for this process: the hook of a child in the
    same virtual environment does it again, and any other child must not find our libraries
    before its own.
    """
    child = dict(environ)
    if child.pop(_WHEELS_GUARD, None) is None:
        return child
    kept = [
        part
        for part in child.pop("LD_LIBRARY_PATH", "").split(os.pathsep)
        if part and not _added_by_wheels(Path(part))
    ]
    if kept:
        child["LD_LIBRARY_PATH"] = os.pathsep.join(kept)
    return child


def _added_by_wheels(folder: Path) -> bool:
    ours = Path(sys.prefix, "lib")
    return folder == ours or (
        folder.name.startswith("ros_") and folder.suffix == ".libs" and ours in folder.parents
    )


def describe(environ: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Describe the ROS 2 installation, for people. Imports rclpy, which may raise anything."""
    import rclpy
    from rclpy.utilities import get_rmw_implementation_identifier

    place = Path(rclpy.__file__).parent
    version = _rclpy_version(place)
    release = ".".join(version.split(".")[:2])
    return {
        "rclpy": f"{version} in {place}",
        "rmw": get_rmw_implementation_identifier(),
        "distribution": environ.get("ROS_DISTRO") or _DISTRIBUTIONS.get(release, "unknown"),
    }


def _shared_memory_free_bytes() -> int:
    try:
        return shutil.disk_usage("/dev/shm").free
    except OSError:
        return 0


def _rclpy_version(place: Path) -> str:
    from importlib import metadata  # late: it loads Python's email package

    for name in ("ros-rclpy", "rclpy"):  # a wheel also has rclpy's own record, of another version
        for distribution in metadata.distributions(name=name, path=[str(place.parent)]):
            return distribution.version
    return "unknown"
