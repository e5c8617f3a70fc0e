"""``fogft init``: copy a working example from `templates/`.

An existing file is never overwritten unless that was asked for.
"""

import json
import os
from pathlib import Path

from fogft import template_files
from fogft.errors import FogftError
from fogft.poolfile import schema
from fogft.poolfile.tree import nearest

DEFAULT_EXAMPLE = "planner"
POOL_FILE = "pool.yaml"


def examples() -> dict[str, str]:
    """Return the examples, sorted by name: name -> one-line description."""
    found = {}
    for pool in sorted(template_files.folder().glob(f"*/{POOL_FILE}")):
        comments = pool.read_text(encoding="utf-8").split("\n", 3)
        found[pool.parent.name] = comments[2].removeprefix("#").strip()
    return found


def copy_example(name: str, into: Path | str, *, force: bool = False) -> list[Path]:
    """Copy an example's files into a folder, created if needed; return them, the pool file first.
    With `force`, files of the same names are overwritten; others in the folder stay.
    """
    known = examples()
    if name not in known:
        raise FogftError(f"there is no example `{name}`", nearest(name, known))
    source, target = template_files.folder() / name, Path(into)
    found = [
        path.relative_to(source)
        for path in source.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    ]
    names = sorted(found, key=lambda path: (path.name != POOL_FILE, path))
    written = [*(target / relative for relative in names), target / schema.FILE]
    try:
        _check_room(target, written[:-1], force)
        for relative in names:
            (target / relative).parent.mkdir(parents=True, exist_ok=True)
            (target / relative).write_bytes((source / relative).read_bytes())
        form = json.dumps(schema.pool_schema(), indent=2) + "\n"
        written[-1].write_text(form, encoding="utf-8")  # its first line names this, for editors
    except OSError as error:
        what = f"`{error.filename or target}` cannot be written: {error.strerror}"
        raise FogftError(what, "choose another folder with `--into DIR`") from error
    return written


def _check_room(target: Path, files: list[Path], force: bool) -> None:
    if os.path.lexists(target) and not target.is_dir():
        raise FogftError(f"`{target}` is not a folder", "choose another folder with `--into DIR`")
    taken = [path for path in files if os.path.lexists(path)]
    for path in taken:
        if path.is_dir():
            raise FogftError(f"`{path}` is a folder", "choose another folder with `--into DIR`")
    if taken and not force:
        listed = ", ".join(f"`{path}`" for path in taken)
        hint = "choose another folder with `--into DIR`, or overwrite with `--force`"
        raise FogftError(f"{listed} exist{'s' if len(taken) == 1 else ''} already", hint)
