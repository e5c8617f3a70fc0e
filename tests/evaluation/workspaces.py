"""Examples with a type of their own, ready to run: copied, built by colcon, and sourced.

Built once into `.reproduce/` of this checkout and kept, since a build takes half a minute.

Owns: those folders, and this process's environment. Not here: pools (`pools`).
"""

from __future__ import annotations

import ctypes
import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from fogft import disk, template_files
from tests.bench.rig import ROOT
from tests.evaluation.errors import EvaluationError

FOLDER = ROOT / ".reproduce"
PROGRAMS = {"g++": "g++", "cmake": "cmake", "ninja": "ninja-build", "colcon": ""}
_BUILD_LIMIT_S = 900.0


def ready(example: str) -> Path:
    """Copy an example and build its types, where that was not done; return its folder.

    Raises:
        EvaluationError: A program that builds is missing, or the build failed.
    """
    folder = FOLDER / example
    folder.mkdir(parents=True, exist_ok=True)
    path = f"{Path(sys.executable).parent}:{os.environ.get('PATH', os.defpath)}"
    missing = [name for name in PROGRAMS if shutil.which(name, path=path) is None]
    if missing:
        packages = " ".join(filter(None, (PROGRAMS[name] for name in missing)))
        raise EvaluationError(
            f"{example} has a type of its own, and {', '.join(missing)} to build it is missing "
            f"(Debian: apt install {packages or 'python3-colcon-common-extensions'})"
        )
    with disk.locked(FOLDER / f"{example}.lock"):
        _copy(template_files.folder() / example, folder)
        done = subprocess.run(
            ["bash", str(template_files.folder() / "workspace.sh")],
            cwd=folder, env={**os.environ, "PATH": path}, capture_output=True, text=True,
            timeout=_BUILD_LIMIT_S, check=False,
        )  # fmt: skip
    if done.returncode:
        said = "\n".join((done.stdout + done.stderr).splitlines()[-20:])
        raise EvaluationError(f"the types of {example} could not be built:\n{said}")
    return folder


def adopt(folder: Path, type: str) -> Any:
    """Source a built workspace in this process, and in all that it starts from now on.

    Args:
        folder: As `ready` returned it.
        type: Such as ``detect_interfaces/srv/Detect``.

    Returns:
        The class of the type.
    """
    words = ["bash", "-c", f". '{folder}/install/setup.bash' && env -0"]
    out = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    sourced = dict(line.split("=", 1) for line in out.split("\0") if "=" in line)
    for key in ("AMENT_PREFIX_PATH", "LD_LIBRARY_PATH", "PYTHONPATH"):
        os.environ[key] = sourced.get(key, "")
    package, _, name = type.split("/")
    for place in folder.glob(f"install/{package}/lib/python*/site-packages"):
        if str(place) not in sys.path:
            sys.path.append(str(place))
    _load(sorted(folder.glob(f"install/{package}/lib/*.so")))
    return getattr(importlib.import_module(f"{package}.srv"), name)


def _load(libraries: list[Path]) -> None:
    """Load libraries that need one another.

    The loader read LD_LIBRARY_PATH when this process began, so it finds only what is loaded.
    """
    left = libraries
    while left:
        failed = []
        for library in left:
            try:
                ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
            except OSError as error:
                failed.append((library, error))
        if len(failed) == len(left):
            raise EvaluationError(f"{failed[0][0]} cannot be loaded: {failed[0][1]}")
        left = [library for library, _ in failed]


def _copy(source: Path, target: Path) -> None:
    """Copy what has changed; an untouched definition is not built again."""
    for path in source.rglob("*"):
        if not path.is_file() or "__pycache__" in path.parts:
            continue
        copy = target / path.relative_to(source)
        data = path.read_bytes()
        if not copy.is_file() or copy.read_bytes() != data:
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(data)
