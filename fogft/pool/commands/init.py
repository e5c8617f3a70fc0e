"""Copy a working example out of `templates/`: what `fogft init` does.

Either all files of the example arrive, or none: they are copied beside their place first,
and a file that is already there is never overwritten unless that was asked for.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from fogft import template_files
from fogft.errors import FogftError
from fogft.poolfile import schema
from fogft.poolfile.tree import nearest

DEFAULT_EXAMPLE = "planner"
POOL_FILE = "pool.yaml"


def examples() -> dict[str, str]:
    """Return what can be copied: name and one line of description, by name."""
    found = {}
    for pool in sorted(template_files.folder().glob(f"*/{POOL_FILE}")):
        comments = pool.read_text(encoding="utf-8").split("\n", 3)
        found[pool.parent.name] = comments[2].removeprefix("#").strip()
    return found


def copy_example(name: str, into: Path | str, *, force: bool = False) -> list[Path]:
    """Copy an example's files into a folder, which is made if need be; return them, the pool file
    first. With `force` files of the same names are overwritten; others in the folder stay.

    Raises:
        FogftError: There is no such example, a file is in the way, or the folder cannot be
            written. Then nothing was changed.
    """
    known = examples()
    if name not in known:
        raise FogftError(f"there is no example `{name}`", nearest(name, known))
    source, target = template_files.folder() / name, Path(into)
    names = sorted(_files(source), key=lambda path: (path.name != POOL_FILE, path))
    try:
        _check_room(target, names, force)
        _copy(source, target, names)
        write_schema(target / schema.FILE)
    except OSError as error:
        what = f"`{error.filename or target}` cannot be written: {error.strerror}"
        raise FogftError(what, "choose another folder with `--into DIR`") from error
    return [*(target / relative for relative in names), target / schema.FILE]


def write_schema(path: Path) -> None:
    """Write the JSON Schema that the first line of a pool file names, for editors."""
    path.write_text(json.dumps(schema.pool_schema(), indent=2) + "\n", encoding="utf-8")


def _files(source: Path) -> Iterator[Path]:
    """Yield the example's files, relative to it, without what Python leaves behind."""
    for path in source.rglob("*"):
        if path.is_file() and "__pycache__" not in path.parts:
            yield path.relative_to(source)


def _check_room(target: Path, names: list[Path], force: bool) -> None:
    if os.path.lexists(target) and not target.is_dir():
        raise FogftError(f"`{target}` is not a folder", "choose another folder with `--into DIR`")
    taken = [target / name for name in names if os.path.lexists(target / name)]
    for path in taken:
        if path.is_dir():
            raise FogftError(f"`{path}` is a folder", "choose another folder with `--into DIR`")
    if taken and not force:
        listed = ", ".join(f"`{path}`" for path in taken)
        hint = "choose another folder with `--into DIR`, or overwrite with `--force`"
        raise FogftError(f"{listed} exist{'s' if len(taken) == 1 else ''} already", hint)


def _copy(source: Path, target: Path, names: list[Path]) -> None:
    """Copy all into a folder within the target, then rename each file into place.

    What can fail for want of space or rights fails before the first rename.
    """
    made = _make_folders(target)
    try:
        with tempfile.TemporaryDirectory(dir=target, prefix=".fogft-init-") as staging:
            for name in names:
                (staging / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source / name, staging / name)
            for name in names:
                (target / name).parent.mkdir(parents=True, exist_ok=True)
                os.replace(staging / name, target / name)
    except OSError:
        for folder in made:
            with contextlib.suppress(OSError):  # what could not be made, or is not empty
                folder.rmdir()
        raise


def _make_folders(target: Path) -> list[Path]:
    """Make a folder and what leads to it; return the new ones, the innermost first."""
    missing = [path for path in (target, *target.parents) if not path.exists()]
    target.mkdir(parents=True, exist_ok=True)
    return missing
