"""Options that several commands have, and what the shell offers for them after a Tab.

A completion never fails and never prints: what cannot be known is not offered.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated

import typer


def _quietly(source: Callable[[], Iterable[str]], incomplete: str) -> list[str]:
    try:
        return [value for value in source() if value.startswith(incomplete)]
    except Exception:
        return []


def pools(incomplete: str) -> list[str]:
    """Names of the pools on this machine."""
    return _quietly(_pools, incomplete)


def slots(incomplete: str) -> list[str]:
    """Slots of the only pool, or of all pools."""

    def found() -> Iterable[str]:
        from fogft.pool.commands import status
        from fogft.pool.folder.paths import PoolPaths

        every = {slot for pool in _pools() for slot in status.slots(PoolPaths.of(pool))}
        return map(str, sorted(every))

    return _quietly(found, incomplete)


def locations(incomplete: str) -> list[str]:
    """Regions and zones that the pools' replicas are in."""

    def found() -> Iterable[str]:
        from fogft.pool.commands import status
        from fogft.pool.folder.paths import PoolPaths

        seen = [status.read(PoolPaths.of(pool), 0.0).status for pool in _pools()]
        zones = {replica.location for one in seen for replica in one.replicas}
        return sorted(zones | {zone.rsplit("/", 1)[0] for zone in zones})

    return _quietly(found, incomplete)


def excluded(incomplete: str) -> list[str]:
    """Locations that are excluded now."""

    def found() -> Iterable[str]:
        from fogft.pool.commands import composition

        return sorted({x for p in _pools() for x in composition.make_store(p).intent().excluded})

    return _quietly(found, incomplete)


def examples(incomplete: str) -> list[str]:
    """Names of the examples that ``fogft init`` can write."""
    from fogft.pool.commands import init

    return _quietly(init.examples, incomplete)


def _pools() -> list[str]:
    from fogft.pool.commands import composition

    return composition.pools()


PoolOption = Annotated[
    str | None,
    typer.Option(
        "--pool",
        "-p",
        help="Pool name; required if there are several.",
        autocompletion=pools,
        show_default=False,
        metavar="NAME",
    ),
]
PoolArgument = Annotated[
    str | None,
    typer.Argument(
        help="Pool name; required if there are several.", autocompletion=pools, show_default=False
    ),
]
Slot = Annotated[
    int, typer.Argument(min=0, metavar="SLOT", help="See `fogft status`.", autocompletion=slots)
]
PoolFile = Annotated[Path, typer.Argument(metavar="FILE", help="The pool file.")]
DEFAULT_FILE = Path("pool.yaml")
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
