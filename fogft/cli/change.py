"""``fogft scale | drain | exclude | include``: ask a running pool for something else.

Each records the wish on disk and returns; the manager acts on it within a tick, and
still does after it was killed.
"""

from __future__ import annotations

from typing import Annotated

import typer

from fogft.cli import complete, output
from fogft.cli.complete import PoolOption
from fogft.cli.sections import Command

Count = Annotated[int, typer.Argument(min=1, max=16, metavar="N", help="How many.")]


def register(app: typer.Typer) -> None:
    """Add these commands to the application."""
    group = typer.Typer(rich_markup_mode=None, help="Ask for more or fewer replicas.")
    group.command("up", cls=Command)(scale_up)
    group.command("down", cls=Command)(scale_down)
    app.add_typer(group, name="scale")
    app.command("drain", cls=Command)(drain)
    app.command("exclude", cls=Command)(exclude)
    app.command("include", cls=Command)(include)


def scale_up(count: Count, pool: PoolOption = None) -> None:
    """Ask for N more replicas.

    This stays until the pool file's own `replicas` changes.

    \b
    Example:
      fogft scale up 1
    """
    _scale(pool, count)


def scale_down(count: Count, pool: PoolOption = None) -> None:
    """Ask for N fewer replicas; at least one stays.

    This stays until the pool file's own `replicas` changes. Replicas that go finish
    what they work on first.

    \b
    Example:
      fogft scale down 1
    """
    _scale(pool, -count)


def drain(
    slot: Annotated[
        int,
        typer.Argument(
            min=0, metavar="SLOT", help="See `fogft status`.", autocompletion=complete.slots
        ),
    ],
    pool: PoolOption = None,
) -> None:
    """Replace one replica, the new one first.

    The old one finishes what it works on, and goes.

    \b
    Example:
      fogft drain 2
    """
    from fogft import app

    name = app.pool_name(pool)
    replica = app.drain(name, slot)
    output.done(f"replica `{replica}` of `{name}` is to be replaced")
    _remark_on_manager(name)


def exclude(
    location: Annotated[
        str,
        typer.Argument(
            metavar="LOCATION",
            autocompletion=complete.locations,
            help="`cloud`, `cloud/region` or `cloud/region/zone`.",
        ),
    ],
    pool: PoolOption = None,
) -> None:
    """Launch nothing in a location, and move away what runs there.

    \b
    Example:
      fogft exclude local/us-west-2
    """
    from fogft import app

    name = app.pool_name(pool)
    changed = app.exclude(name, location)
    output.done(f"`{location}` {'is now' if changed else 'was already'} excluded from `{name}`")
    _remark_on_manager(name)


def include(
    location: Annotated[
        str,
        typer.Argument(
            metavar="LOCATION",
            autocompletion=complete.excluded,
            help="As it was given to `exclude`.",
        ),
    ],
    pool: PoolOption = None,
) -> None:
    """Allow a location again that was excluded.

    \b
    Example:
      fogft include local/us-west-2
    """
    from fogft import app

    name = app.pool_name(pool)
    app.include(name, location)
    output.done(f"`{location}` may be used by `{name}` again")
    _remark_on_manager(name)


def _scale(pool: str | None, by: int) -> None:
    from fogft import app

    name = app.pool_name(pool)
    before, after = app.scale(name, by)
    output.done(f"`{name}` shall have {after} replicas (was {before})")
    _remark_on_manager(name)


def _remark_on_manager(pool: str) -> None:
    from fogft import app

    if not app.manager_alive(pool):
        output.warn(f"no manager of `{pool}` runs: this happens once one does")
        output.hint(f"start it with `fogft up {app.file_of(pool)}`")
