"""Find and end machines that no manager owns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fogft.app.clouds import LOCAL, SKY, make_cloud
from fogft.errors import FogftError
from fogft.pool.folder.paths import home

if TYPE_CHECKING:
    from fogft.pool.commands.sweep import Unowned


@dataclass(frozen=True)
class Swept:
    """What was found in one cloud of `CLOUDS`.

    Attributes:
        asked: Clouds whose own list was read.
    """

    cloud: str
    unowned: Sequence[Unowned]
    asked: frozenset[str]


def clouds_to_sweep() -> list[str]:
    """Return where machines of this user can be, as far as is known here."""
    return [LOCAL, *([SKY] if (home() / SKY).exists() else [])]


def sweep(cloud: str) -> Swept:
    """Return the machines of this user's pools in a cloud that no manager owns.

    Raises:
        CloudUnreachable: It cannot tell what exists.
        CloudError: There is no such cloud, or it is not usable here.
    """
    from fogft.cloud.port import Auditing
    from fogft.pool.commands import sweep

    concrete = make_cloud(cloud, Path.cwd())
    if not isinstance(concrete, Auditing):
        raise FogftError(f"cloud `{cloud}` cannot be swept")
    unowned, audit = sweep.find(concrete, home())
    return Swept(cloud, unowned, audit.asked)


def end_unowned(found: Swept, told: Callable[[str], None]) -> list[FogftError]:
    """End what was found, but what a manager has taken over since; return what went wrong."""
    from fogft.pool.commands import sweep

    return sweep.end(make_cloud(found.cloud, Path.cwd()), found.unowned, home(), told=told)
