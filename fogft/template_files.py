"""The `templates/` folder: examples, scripts and profiles shipped with fogft."""

from pathlib import Path

from fogft.errors import FogftError


def folder() -> Path:
    """Return the templates folder of the installed package or of this checkout."""
    package = Path(__file__).resolve().parent
    for candidate in (package / "templates", package.parent / "templates"):
        if (candidate / "echo" / "pool.yaml").is_file():
            return candidate
    raise FogftError(
        f"the templates are missing from the installation in `{package}`",
        "reinstall fogft",
    )


def read_text(name: str) -> str:
    """Return the text of a template."""
    path = folder() / name
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise FogftError(f"the template `{path}` cannot be read: {reason}") from error
