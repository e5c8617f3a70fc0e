"""Find and read `templates/sky_task.yaml`, in a checkout or in an installed package."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fogft.core.errors import CloudError

_PACKAGE = Path(__file__).resolve().parents[2]


def read() -> dict[str, Any]:
    """Return the template of a replica's SkyPilot task.

    Raises:
        CloudError: The installation is incomplete, or the template was damaged.
    """
    import yaml

    for folder in (_PACKAGE / "templates", _PACKAGE.parent / "templates"):
        path = folder / "sky_task.yaml"
        if path.is_file():
            try:
                value = yaml.safe_load(path.read_text())
            except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
                raise CloudError(f"`{path}` cannot be read: {error}") from error
            if isinstance(value, dict):
                return value
            raise CloudError(f"`{path}` is not a task")
    raise CloudError("fogft's own `templates/sky_task.yaml` is missing", "install fogft again")
