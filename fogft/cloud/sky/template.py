"""Find and read what goes to a VM, in a checkout's `templates` or in an installed package's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fogft.errors import CloudError

_PACKAGE = Path(__file__).resolve().parents[2]


def read() -> dict[str, Any]:
    """Return the template of a replica's SkyPilot task, `sky_task.yaml`.

    Raises:
        CloudError: The installation is incomplete, or the template was damaged.
    """
    import yaml

    name = "sky_task.yaml"
    try:
        value = yaml.safe_load(read_text(name))
    except yaml.YAMLError as error:
        raise CloudError(f"fogft's own `templates/{name}` cannot be read: {error}") from error
    if not isinstance(value, dict):
        raise CloudError(f"fogft's own `templates/{name}` is not a task", "install fogft again")
    return value


def read_text(name: str) -> str:
    """Return the text of a template. Raises CloudError: the installation is incomplete."""
    for folder in (_PACKAGE / "templates", _PACKAGE.parent / "templates"):
        path = folder / name
        if path.is_file():
            try:
                return path.read_text()
            except (OSError, UnicodeDecodeError) as error:
                raise CloudError(f"`{path}` cannot be read: {error}") from error
    raise CloudError(f"fogft's own `templates/{name}` is missing", "install fogft again")
