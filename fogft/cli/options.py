"""Options shared by several commands, and their completion, which never fails or prints."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated

import typer

from fogft.errors import FogftError
from fogft.pool.commands import composition
from fogft.pool.folder.paths import PoolPaths


def _offer(known: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    def offer(incomplete: str) -> list[str]:
        try:
            return [value for value in known() if value.startswith(incomplete)]
        except Exception:
            return []

    return offer


def _slots() -> list[str]:
    from fogft.pool.commands import status

    every = {slot for pool in composition.pools() for slot in status.slots(PoolPaths.of(pool))}
    return [str(slot) for slot in sorted(every)]


def _locations() -> list[str]:
    from fogft.pool.commands import status

    seen = [status.read(PoolPaths.of(pool), 0.0).status for pool in composition.pools()]
    zones = {replica.location for one in seen for replica in one.replicas}
    return sorted(zones | {zone.rsplit("/", 1)[0] for zone in zones})


def _excluded() -> list[str]:
    stores = map(composition.make_store, composition.pools())
    return sorted({location for store in stores for location in store.intent().excluded})


def _examples() -> Iterable[str]:
    from fogft.pool.commands import init

    return init.examples()


pools, slots, examples = _offer(composition.pools), _offer(_slots), _offer(_examples)
locations, excluded = _offer(_locations), _offer(_excluded)

PoolOption = Annotated[
    str | None,
    typer.Option(
        "--pool",
        "-p",
        help="Pool name; required if there are several.",
        autocompletion=pools,
        metavar="NAME",
    ),
]
PoolName = Annotated[str, typer.Argument(metavar="POOL", help="Pool name.", autocompletion=pools)]
PoolArgument = Annotated[
    str | None,
    typer.Argument(help="Pool name; required if there are several.", autocompletion=pools),
]
Slot = Annotated[
    int, typer.Argument(min=0, metavar="SLOT", help="See `fogft status`.", autocompletion=slots)
]
PoolFile = Annotated[Path, typer.Argument(metavar="FILE", help="The pool file.")]
DEFAULT_FILE = Path("pool.yaml")
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Cloud = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Cloud; by default the one in the file, else `local`."),
]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Skip confirmation.")]
Plot = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Plot to a PNG, SVG or PDF file as well.")
]


def one_pool(argument: str | None, option: str | None) -> str | None:
    """Return the pool named by the argument or the option. Raises FogftError if they differ."""
    if argument and option and argument != option:
        raise FogftError(f"two pools are named, `{argument}` and `--pool {option}`", "name one")
    return argument or option
