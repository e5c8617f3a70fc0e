"""Read a pool file from disk. The only place that knows it is YAML is `yaml_tree`.

Owns: opening the file, its size and its encoding.
Not here: what may stand in it (`fogft.poolfile.reader`).
"""

from __future__ import annotations

from pathlib import Path

from fogft.errors import SpecError
from fogft.model.spec import PoolSpec
from fogft.poolfile import yaml_tree
from fogft.poolfile.pool import FieldCheck, StateCheck, ToleranceCheck, TypeCheck, pool_spec

MAX_BYTES = 1 << 20


def read(
    path: Path | str,
    *,
    check_types: TypeCheck | None = None,
    check_fields: FieldCheck | None = None,
    check_states: StateCheck | None = None,
    check_tolerances: ToleranceCheck | None = None,
) -> PoolSpec:
    """Return what a pool file asks for.

    Args:
        path: The file. Its `workdir`, relative to the file's own folder, must exist.
        check_types: Returns why a service type cannot be loaded on this machine, or None
            if it can. Without it the types are not looked up.
        check_fields: Returns why a service type's response has no such boolean field, for
            `ok_field`.
        check_states: Returns why a service's state cannot travel as `state` says, or None.
        check_tolerances: Returns why a type's responses cannot be compared so, or None.

    Raises:
        SpecError: The file cannot be read, or its first mistake: ``file:line: key: what``.
    """
    return parse(
        read_text(path),
        file=str(path),
        check_types=check_types,
        check_fields=check_fields,
        check_states=check_states,
        check_tolerances=check_tolerances,
        folder=Path(path).parent,
    )


def parse(
    source: str,
    *,
    file: str,
    check_types: TypeCheck | None = None,
    check_fields: FieldCheck | None = None,
    check_states: StateCheck | None = None,
    check_tolerances: ToleranceCheck | None = None,
    folder: Path | None = None,
) -> PoolSpec:
    """Return what the text of a pool file asks for.

    Args:
        source: The text.
        file: Its name, for messages; its stem names the pool where the text does not.
        check_types: As for `read`.
        check_fields: As for `read`.
        check_states: As for `read`.
        check_tolerances: As for `read`.
        folder: Where `workdir` is looked for; None to leave it unjudged.

    Raises:
        SpecError: The first mistake: ``file:line: key: what``.
    """
    if len(source) > MAX_BYTES:
        raise _too_large(file)
    return pool_spec(
        yaml_tree.tree(source, file),
        file,
        check_types=check_types,
        check_fields=check_fields,
        check_states=check_states,
        check_tolerances=check_tolerances,
        check_workdir=None if folder is None else lambda workdir: _no_folder(folder, workdir),
    )


def read_text(path: Path | str) -> str:
    """Return a pool file's text, as it stands on disk but for a byte order mark.

    Raises:
        SpecError: It cannot be read, is too large or is not UTF-8.
    """
    try:
        with open(path, "rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except IsADirectoryError:
        hint = f"name the file in it, such as `{Path(path) / 'pool.yaml'}`"
        raise SpecError(f"{path}: is a folder, not a pool file", hint) from None
    except FileNotFoundError:
        hint = "check the path, or run `fogft init` for a working example"
        raise SpecError(f"{path}: no such file", hint) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        hint = "check the path and its permissions"
        raise SpecError(f"{path}: cannot be read: {reason}", hint) from None
    if len(raw) > MAX_BYTES:
        raise _too_large(str(path))
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        hint = "save it as UTF-8"
        raise SpecError(f"{path}:{line}: is not UTF-8 text: {error.reason}", hint) from None


def _no_folder(base: Path, workdir: str) -> str | None:
    if "://" in workdir:  # a repository, not a folder of this machine
        return None
    try:
        folder = (base / Path(workdir).expanduser()).resolve()
        if folder.is_dir():
            return None
    except (OSError, ValueError, RuntimeError) as error:
        return f"`{workdir}` cannot be looked at: {error}"
    return f"there is no folder `{folder}`; a relative path begins at the pool file's own folder"


def _too_large(file: str) -> SpecError:
    what = f"{file}: is larger than {MAX_BYTES >> 20} MiB"
    return SpecError(what, "a pool file is short; is this the right file?")
