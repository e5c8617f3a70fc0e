"""Read `sky_task.yaml`, the template of a replica's SkyPilot task."""

from __future__ import annotations

from typing import Any

from fogft import template_files
from fogft.errors import CloudError, FogftError

_NAME = "sky_task.yaml"


def read() -> dict[str, Any]:
    """Return the template. Raises CloudError: the installation is incomplete or damaged."""
    import yaml

    try:
        value = yaml.safe_load(template_files.read_text(_NAME))
    except (FogftError, yaml.YAMLError) as error:
        raise CloudError(f"fogft's own `{_NAME}` cannot be read: {error}") from error
    if not isinstance(value, dict):
        raise CloudError(f"fogft's own `{_NAME}` is not a task", "install fogft again")
    return value
