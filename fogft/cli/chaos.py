"""``fogft chaos``: make things go wrong in a pool on the local cloud, on purpose."""

from __future__ import annotations

from typing import Annotated

import typer

from fogft.cli import complete, output
from fogft.cli.complete import PoolOption
from fogft.cli.sections import Command

Slot = Annotated[
    int,
    typer.Argument(
        min=0, metavar="SLOT", help="See `fogft status`.", autocompletion=complete.slots
    ),
]
Location = Annotated[
    str,
    typer.Argument(
        metavar="LOCATION",
        help="`local/region` or `local/region/zone`.",
        autocompletion=complete.locations,
    ),
]
Duration = Annotated[
    float | None,
    typer.Option(
        "--for", min=0, metavar="S", help="Seconds; until `clear` unless told.", show_default=False
    ),
]


def register(app: typer.Typer) -> None:
    """Add this family to the application."""
    group = typer.Typer(
        rich_markup_mode=None, help="Make things go wrong in a pool on the local cloud."
    )
    for command in (preempt, kill, freeze, thaw, slow, blackhole, outage, capacity, clear):
        group.command(command.__name__, cls=Command)(command)
    app.add_typer(group, name="chaos")


def preempt(
    slot: Slot,
    notice: Annotated[
        float | None,
        typer.Option(
            "--notice",
            min=0,
            metavar="S",
            show_default=False,
            help="Seconds until the end, instead of the zone's own.",
        ),
    ] = None,
    pool: PoolOption = None,
) -> None:
    """Take a replica's machine away as a spot market does: a notice, then the end.

    \b
    Example:
      fogft chaos preempt 0
    """
    from fogft import app

    machine = app.machine_in(app.pool_name(pool), slot)
    left_s = app.chaos().preempt(machine, notice)
    output.done(f"replica `{machine.short}` has notice and ends in {left_s:.0f} s")


def kill(slot: Slot, pool: PoolOption = None) -> None:
    """End a replica's machine at once, with SIGKILL.

    \b
    Example:
      fogft chaos kill 0
    """
    from fogft import app

    machine = app.machine_in(app.pool_name(pool), slot)
    app.chaos().kill(machine)
    output.done(f"replica `{machine.short}` was killed")


def freeze(slot: Slot, pool: PoolOption = None) -> None:
    """Stop a replica's machine without ending it, with SIGSTOP.

    \b
    Example:
      fogft chaos freeze 1
    """
    from fogft import app

    machine = app.machine_in(app.pool_name(pool), slot)
    count = app.chaos().freeze(machine)
    output.done(f"replica `{machine.short}` is frozen ({count} processes)")


def thaw(slot: Slot, pool: PoolOption = None) -> None:
    """Let a frozen machine go on.

    \b
    Example:
      fogft chaos thaw 1
    """
    from fogft import app

    machine = app.machine_in(app.pool_name(pool), slot)
    count = app.chaos().thaw(machine)
    output.done(f"replica `{machine.short}` goes on ({count} processes)")


def slow(
    slot: Slot,
    delay_ms: Annotated[
        float, typer.Argument(min=0, metavar="MS", help="Milliseconds added each way.")
    ],
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate", min=0.001, metavar="MBPS", help="Megabits per second.", show_default=False
        ),
    ] = None,
    lasting: Duration = None,
    pool: PoolOption = None,
) -> None:
    """Delay all that passes over the link to a replica.

    \b
    Example:
      fogft chaos slow 1 80
    """
    from fogft import app

    machine = app.machine_in(app.pool_name(pool), slot)
    bytes_per_s = None if rate is None else rate * 1e6 / 8
    app.chaos().slow(machine, delay_ms / 1000, bytes_per_s, lasting)
    limit = "" if rate is None else f" and passes {rate:g} Mbit/s"
    output.done(f"the link to `{machine.short}` takes {delay_ms:g} ms more each way{limit}")


def blackhole(slot: Slot, lasting: Duration = None, pool: PoolOption = None) -> None:
    """Let nothing pass over the link to a replica, without closing it.

    \b
    Example:
      fogft chaos blackhole 1
    """
    from fogft import app

    machine = app.machine_in(app.pool_name(pool), slot)
    app.chaos().blackhole(machine, lasting)
    output.done(f"nothing passes over the link to `{machine.short}` any more")


def outage(location: Location, lasting: Duration = None) -> None:
    """End all machines in a location, and launch none there, until `clear`.

    \b
    Example:
      fogft chaos outage local/us-west-2
    """
    from fogft import app

    hit = app.chaos().outage(location, lasting)
    names = ", ".join(f"`{machine.short}`" for machine in hit) or "no machine"
    output.done(f"`{location}` is out; it hits {names}")


def capacity(
    location: Location,
    machines: Annotated[int, typer.Argument(min=0, metavar="N", help="How many fit in.")],
) -> None:
    """Say how many machines fit into a location.

    \b
    Example:
      fogft chaos capacity local/us-west-2 0
    """
    from fogft import app

    app.chaos().capacity(location, machines)
    output.done(f"`{location}` has room for {machines} machines; those that run stay")


def clear() -> None:
    """Undo what lasts: slow and dead links, frozen machines, outages, capacities.

    \b
    Example:
      fogft chaos clear
    """
    from fogft import app

    app.chaos().clear()
    output.done("nothing is slow, dead, frozen, out or full on purpose any more")
