"""``fogft chaos``: make things go wrong in a pool on the local cloud, on purpose."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from fogft.cli import options, output
from fogft.cli.commands import Command, group
from fogft.cli.options import PoolOption, Slot
from fogft.errors import FogftError, known_slots

if TYPE_CHECKING:
    from fogft.cloud.local.chaos import Chaos
    from fogft.model.replica import ReplicaId

Location = Annotated[
    str,
    typer.Argument(
        metavar="LOCATION",
        help="`local/region` or `local/region/zone`.",
        autocompletion=options.locations,
    ),
]
Duration = Annotated[
    float | None,
    typer.Option(
        "--for", min=0, metavar="S", help="Seconds; until `clear` unless told.", show_default=False
    ),
]


chaos = group("Make things go wrong in a pool on the local cloud.")


@chaos.command(cls=Command)
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
    machine = _machine(pool, slot)
    left_s = _chaos().preempt(machine, notice)
    output.done(f"replica `{machine.short}` has notice and ends in {left_s:.0f} s")


@chaos.command(cls=Command)
def kill(slot: Slot, pool: PoolOption = None) -> None:
    """End a replica's machine at once, with SIGKILL.

    \b
    Example:
      fogft chaos kill 0
    """
    machine = _machine(pool, slot)
    _chaos().kill(machine)
    output.done(f"replica `{machine.short}` was killed")


@chaos.command(cls=Command)
def freeze(slot: Slot, pool: PoolOption = None) -> None:
    """Stop a replica's machine without ending it, with SIGSTOP.

    \b
    Example:
      fogft chaos freeze 1
    """
    machine = _machine(pool, slot)
    count = _chaos().freeze(machine)
    output.done(f"replica `{machine.short}` is frozen ({count} processes)")


@chaos.command(cls=Command)
def thaw(slot: Slot, pool: PoolOption = None) -> None:
    """Let a frozen machine go on.

    \b
    Example:
      fogft chaos thaw 1
    """
    machine = _machine(pool, slot)
    count = _chaos().thaw(machine)
    output.done(f"replica `{machine.short}` goes on ({count} processes)")


@chaos.command(cls=Command)
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
    machine = _machine(pool, slot)
    bytes_per_s = None if rate is None else rate * 1e6 / 8
    _chaos().slow(machine, delay_ms / 1000, bytes_per_s, lasting)
    limit = "" if rate is None else f" and passes {rate:g} Mbit/s"
    output.done(f"the link to `{machine.short}` takes {delay_ms:g} ms more each way{limit}")


@chaos.command(cls=Command)
def blackhole(slot: Slot, lasting: Duration = None, pool: PoolOption = None) -> None:
    """Let nothing pass over the link to a replica, without closing it.

    \b
    Example:
      fogft chaos blackhole 1
    """
    machine = _machine(pool, slot)
    _chaos().blackhole(machine, lasting)
    output.done(f"nothing passes over the link to `{machine.short}` any more")


@chaos.command(cls=Command)
def outage(location: Location, lasting: Duration = None) -> None:
    """End all machines in a location, and launch none there, until `clear`.

    \b
    Example:
      fogft chaos outage local/us-west-2
    """
    hit = _chaos().outage(location, lasting)
    names = ", ".join(f"`{machine.short}`" for machine in hit) or "no machine"
    output.done(f"`{location}` is out; it hits {names}")


@chaos.command(cls=Command)
def capacity(
    location: Location,
    machines: Annotated[int, typer.Argument(min=0, metavar="N", help="How many fit in.")],
) -> None:
    """Say how many machines fit into a location.

    \b
    Example:
      fogft chaos capacity local/us-west-2 0
    """
    _chaos().capacity(location, machines)
    output.done(f"`{location}` has room for {machines} machines; those that run stay")


@chaos.command(cls=Command)
def clear() -> None:
    """Undo what lasts: slow and dead links, frozen machines, outages, capacities.

    \b
    Example:
      fogft chaos clear
    """
    _chaos().clear()
    output.done("nothing is slow, dead, frozen, out or full on purpose any more")


def _chaos() -> Chaos:
    from fogft.cloud.local.chaos import Chaos
    from fogft.pool.commands import composition

    return Chaos(composition.local_root())


def _machine(pool: str | None, slot: int) -> ReplicaId:
    """Return the newest machine that the cloud lists in a slot of a pool."""
    from fogft.pool.commands import composition

    identity = composition.store_of(pool).identity()
    machines = composition.cloud_of(identity).machines(identity.uid)
    found = [machine.id for machine in machines if machine.id.slot == slot]
    if not found:
        known = known_slots(machine.id.slot for machine in machines)
        raise FogftError(
            f"no machine runs in slot {slot} of `{identity.name}`", f"slots with one: {known}"
        )
    return max(found)
