"""Judge a pool file whole, with all that this machine can tell, and change nothing."""

from __future__ import annotations

from pathlib import Path

from fogft.errors import SpecError
from fogft.pool.commands.composition import LOCAL, cloud_named_by, make_cloud
from fogft.poolfile import file as pool_file
from fogft.poolfile import named_clouds
from fogft.poolfile.pool import Checks


def checks_here() -> Checks:
    """Return what only this machine can tell: which types are installed, and what they hold."""
    from fogft.ros.comparison import check_tolerances
    from fogft.ros.messages import check_ok_field
    from fogft.ros.state_bytes import check_state
    from fogft.ros.types import check_type

    return Checks(check_type, check_ok_field, check_state, check_tolerances)


def mistakes(file: Path) -> list[SpecError]:
    """Return all that is wrong in a pool file, by line.

    What real clouds think of `resources` is left to `fogft plan` and `fogft up`, which ask them.
    """
    checks = checks_here()
    found = pool_file.mistakes(file, checks)
    if found:
        return found
    try:
        source = pool_file.read_text(file)
        spec = pool_file.parse(source, str(file), checks, file.parent)
        if cloud_named_by(spec, source, file) == LOCAL:
            make_cloud(LOCAL, file.resolve().parent).offers(spec.task.get("resources") or {})
    except SpecError as error:
        is_located = error.message.startswith(f"{file}:")
        return [error if is_located else named_clouds.located(error, source, file)]
    return []
