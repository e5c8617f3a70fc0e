"""Read a pool file from disk."""

from functools import partial
from pathlib import Path

from fogft.errors import SpecError
from fogft.model.spec import PoolSpec
from fogft.poolfile import yaml_tree
from fogft.poolfile.pool import UNCHECKED, Checks, pool_spec
from fogft.poolfile.tree import Mistakes

MAX_BYTES = 1 << 20


def read(path: Path | str, checks: Checks = UNCHECKED) -> PoolSpec:
    """Return the spec in a pool file. Its `workdir`, relative to its own folder, must exist."""
    return parse(read_text(path), str(path), checks, Path(path).resolve().parent)


def mistakes(path: Path, checks: Checks = UNCHECKED) -> list[SpecError]:
    """Return all mistakes in a pool file, by line; only the first if it is not YAML.

    Values that depend on a mistake are not checked, and may be wrong once it is corrected.
    """
    found = Mistakes(keep=True)
    with found.step():
        source = read_text(path)
        checks = checks._replace(workdir=partial(_no_folder, path.resolve().parent))
        pool_spec(yaml_tree.tree(source, str(path)), str(path), checks, found)
    return sorted(found.found, key=lambda error: error.line)


def parse(
    source: str, file: str, checks: Checks = UNCHECKED, folder: Path | None = None
) -> PoolSpec:
    """Return the spec in a pool file's text; `workdir` must exist in `folder`, if given.

    The stem of `file` names the pool if the text does not.
    """
    if folder is not None:
        checks = checks._replace(workdir=partial(_no_folder, folder))
    return pool_spec(yaml_tree.tree(source, file), file, checks)


def read_text(path: Path | str) -> str:
    """Return a pool file's text without a byte order mark."""
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
        hint = "a pool file is short; is this the right file?"
        raise SpecError(f"{path}: is larger than {MAX_BYTES >> 20} MiB", hint)
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        hint = "save it as UTF-8"
        raise SpecError(f"{path}:{line}: is not UTF-8 text: {error.reason}", hint) from None


def _no_folder(base: Path, workdir: str) -> SpecError | None:
    if "://" in workdir:  # a repository, not a folder of this machine
        return None
    try:
        folder = (base / Path(workdir).expanduser()).resolve()
        if folder.is_dir():
            return None
    except (OSError, ValueError, RuntimeError) as error:
        return SpecError(f"`{workdir}` cannot be read: {error}")
    hint = "a relative path begins at the pool file's own folder"
    return SpecError(f"there is no folder `{folder}`", hint)
