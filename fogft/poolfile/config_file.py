"""A process's configuration file, written and read by the fields of its dataclass."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from fogft.errors import SpecError, StateError
from fogft.model.plain import Misfit, from_plain, to_plain
from fogft.poolfile import yaml_tree
from fogft.poolfile.tree import below, plain

T = TypeVar("T")
_HINT = "it is written by `fogft up` or `fogft join`: run that again"


def document(config: Any, heading: str) -> str:
    """Return a configuration as YAML, below a comment."""
    import yaml

    comment = "".join(f"# {line}\n" for line in heading.splitlines())
    return comment + yaml.safe_dump(
        to_plain(config, omit_defaults=True), sort_keys=False, width=100
    )


def read(cls: type[T], path: Path, override: Mapping[str, Any] | None = None) -> T:
    """Return a configuration with absolute paths; `override` replaces keys of the file."""
    try:
        root = yaml_tree.tree(path.read_text(), str(path))
        raw = plain(root)
        if isinstance(raw, dict):
            given = {key: value for key, value in (override or {}).items() if value is not None}
            raw = {key: value for key, value in raw.items() if value is not None} | to_plain(given)
        made = from_plain(cls, raw)
    except SpecError as error:
        raise StateError(error.message, error.hint or _HINT) from error
    except Misfit as error:
        raise StateError(f"{path}:{below(root, error.path).line}: {error}", _HINT) from error
    except (OSError, ValueError, RecursionError) as error:
        raise StateError(f"`{path}` cannot be used: {error}", _HINT) from error
    resolved: T = _resolved(made, path.resolve().parent)
    return resolved


def _resolved(value: Any, base: Path) -> Any:
    """Return a dataclass with its relative paths resolved against a folder."""
    changed: dict[str, Any] = {}
    for one in fields(value):
        held = getattr(value, one.name)
        if isinstance(held, Path):
            changed[one.name] = base / held
        elif is_dataclass(held) and not isinstance(held, type):
            changed[one.name] = _resolved(held, base)
    return replace(value, **changed) if changed else value
