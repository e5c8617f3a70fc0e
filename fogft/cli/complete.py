"""What the shell offers after a Tab: pools, slots, locations and examples that exist.

A completion never fails and never prints: what cannot be known is not offered.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Annotated

import typer


def _quietly(source: Callable[[], Iterable[str]], incomplete: str) -> list[str]:
    try:
        return [value for value in source() if value.startswith(incomplete)]
    except Exception:
        return []


def pools(incomplete: str) -> list[str]:
    """Names of the pools on this machine."""
    from fogft import app

    return _quietly(app.pools, incomplete)


def slots(incomplete: str) -> list[str]:
    """Slots of the only pool, or of all pools."""
    from fogft import app

    return _quietly(
        lambda: map(str, sorted({s for p in app.pools() for s in app.slots(p)})), incomplete
    )


def locations(incomplete: str) -> list[str]:
    """Locations that the pools' replicas are in."""
    from fogft import app

    return _quietly(lambda: sorted({x for p in app.pools() for x in app.locations(p)}), incomplete)


def excluded(incomplete: str) -> list[str]:
    """Locations that are excluded now."""
    from fogft import app

    return _quietly(lambda: sorted({x for p in app.pools() for x in app.excluded(p)}), incomplete)


def examples(incomplete: str) -> list[str]:
    """Names of the examples that ``fogft init`` can write."""
    from fogft import app

    return _quietly(app.examples, incomplete)


PoolOption = Annotated[
    str | None,
    typer.Option(
        "--pool",
        "-p",
        help="Which pool; needed when there are several.",
        autocompletion=pools,
        show_default=False,
        metavar="NAME",
    ),
]
PoolArgument = Annotated[
    str | None,
    typer.Argument(
        help="Which pool; needed when there are several.", autocompletion=pools, show_default=False
    ),
]
