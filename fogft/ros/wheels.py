"""Prepare builds against the ROS 2 wheels: ``python -m fogft.ros.wheels FOLDER``.

The wheels' CMake files name the Python of the machine that built them. This creates a prefix in
which they name the running Python; everything else is symlinked. Interface packages can be built
against it. An installed ROS 2 distribution needs none of this.

Owns: that prefix. Not here: building (`templates/workspace.sh`).
"""

import re
import shutil
import sys
import sysconfig
from pathlib import Path

from fogft.errors import FogftError, RosError

_HEADERS = re.compile(r"/opt/python/[^/;\"]+/include/python[0-9.]+")
_NUMPY = re.compile(r"/opt/python/[^;\"]+/numpy/(?:_core|core)/include")
_NEEDED = "share/rosidl_default_generators/cmake"


def lay_prefix(into: Path) -> Path:
    """Create a prefix to build against, or replace an older one; return it.

    Raises RosError: The wheels for building are missing, or the folder cannot be written.
    """
    wheels = Path(sys.prefix)
    if not (wheels / _NEEDED).is_dir():
        raise RosError(
            "the installed ROS 2 wheels cannot build interface packages",
            "`pip install 'fogft[ros-test]'` has what they lack",
        )
    import numpy

    try:
        if into.exists():
            shutil.rmtree(into)
        into.mkdir(parents=True)
        for entry in wheels.iterdir():
            if entry.name != "share":
                (into / entry.name).symlink_to(entry)
        shutil.copytree(wheels / "share", into / "share", symlinks=True)
        for path in (into / "share").rglob("*.cmake"):
            text = path.read_text()
            named = _NUMPY.sub(str(numpy.get_include()), text)
            named = _HEADERS.sub(sysconfig.get_path("include"), named)
            if named != text:
                path.write_text(named)
    except OSError as error:
        raise RosError(f"`{into}` cannot be written: {error}") from error
    return into


def main(arguments: list[str]) -> int:
    """Create a prefix in the given folder, and print its path."""
    if len(arguments) != 1:
        print("usage: python -m fogft.ros.wheels FOLDER", file=sys.stderr)
        return 2
    try:
        print(lay_prefix(Path(arguments[0]).absolute()))
    except FogftError as error:
        print(f"error: {error.message}\n\nhint: {error.hint}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
