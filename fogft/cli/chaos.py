"""``fogft chaos``: inject faults into a pool on the local cloud."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from fogft.cli import options, output
from fogft.cli.commands import Command, group
from fogft.cli.options import PoolOption, Slot
from fogft.errors import FogftError
from fogft.pool.commands import composition
from fogft.pool.folder.paths import home

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
    typer.Option("--for", min=0, metavar="S", help="Seconds; by default until `clear`."),
]


chaos = group("Inject faults into a pool on the local cloud.")


@chaos.command(cls=Command, epilog="fogft chaos preempt 0")
def preempt(
    slot: Slot,
    notice: Annotated[
        float | None,
        typer.Option(
            min=0, metavar="S", help="Seconds from the notice to the end; by default the zone's."
        ),
    ] = None,
    pool: PoolOption = None,
) -> None:
    """Preempt a replica's machine as a spot market would: a notice, then termination."""
    machine = _machine(pool, slot)
    left_s = _chaos().preempt(machine, notice)
    output.done(
        f"replica `{machine.short}` received a preemption notice and ends in {left_s:.0f} s"
    )


@chaos.command(cls=Command, epilog="fogft chaos kill 0")
def kill(slot: Slot, pool: PoolOption = None) -> None:
    """Kill a replica's machine at once, with SIGKILL."""
    machine = _machine(pool, slot)
    _chaos().kill(machine)
    output.done(f"replica `{machine.short}` was killed")


@chaos.command(cls=Command, epilog="fogft chaos freeze 1")
def freeze(slot: Slot, pool: PoolOption = None) -> None:
    """Freeze a replica's machine, with SIGSTOP."""
    machine = _machine(pool, slot)
    count = _chaos().freeze(machine)
    output.done(f"replica `{machine.short}` is frozen ({count} processes)")


@chaos.command(cls=Command, epilog="fogft chaos thaw 1")
def thaw(slot: Slot, pool: PoolOption = None) -> None:
    """Resume a frozen machine."""
    machine = _machine(pool, slot)
    count = _chaos().thaw(machine)
    if not count:
        output.say(f"replica `{machine.short}` was not frozen; nothing changed")
        return
    output.done(f"replica `{machine.short}` is running again ({count} processes)")


@chaos.command(cls=Command, epilog="fogft chaos slow 1 80")
def slow(
    slot: Slot,
    delay_ms: Annotated[
        float, typer.Argument(min=0, metavar="MS", help="Milliseconds added each way.")
    ],
    rate: Annotated[
        float | None,
        typer.Option(min=0.001, metavar="MBPS", help="Bandwidth limit in megabits per second."),
    ] = None,
    lasting: Duration = None,
    pool: PoolOption = None,
) -> None:
    """Delay everything on the link to a replica."""
    machine = _machine(pool, slot)
    bytes_per_s = None if rate is None else rate * 1e6 / 8
    _chaos().slow(machine, delay_ms / 1000, bytes_per_s, lasting)
    limit = "" if rate is None else f" and limited to {rate:g} Mbit/s"
    output.done(f"the link to `{machine.short}` is delayed by {delay_ms:g} ms each way{limit}")


@chaos.command(cls=Command, epilog="fogft chaos blackhole 1")
def blackhole(slot: Slot, lasting: Duration = None, pool: PoolOption = None) -> None:
    """Drop everything on the link to a replica, without closing it."""
    machine = _machine(pool, slot)
    _chaos().blackhole(machine, lasting)
    output.done(f"the link to `{machine.short}` drops all traffic")


@chaos.command(cls=Command, epilog="fogft chaos outage local/us-west-2")
def outage(location: Location, lasting: Duration = None) -> None:
    """End all machines in a location, and refuse launches there."""
    hit = _chaos().outage(location, lasting)
    names = ", ".join(f"`{machine.short}`" for machine in hit) or "no machine"
    output.done(f"outage in `{location}`; this ends {names}")


@chaos.command(cls=Command, epilog="fogft chaos capacity local/us-west-2 0")
def capacity(
    location: Location,
    machines: Annotated[int, typer.Argument(min=0, metavar="N", help="Number of machines.")],
) -> None:
    """Limit the capacity of a location."""
    _chaos().capacity(location, machines)
    output.done(f"`{location}` now has capacity for {machines} machines; running machines are kept")


@chaos.command(cls=Command, epilog="fogft chaos clear")
def clear() -> None:
    """Clear all injected faults: links, frozen machines, outages and capacity limits."""
    _chaos().clear()
    output.done("all injected faults cleared")


def _chaos() -> Chaos:
    from fogft.cloud.local.chaos import Chaos

    return Chaos(home() / composition.LOCAL)


def _machine(pool: str | None, slot: int) -> ReplicaId:
    from fogft.model.groups import slots_hint

    identity = composition.store_of(pool).identity()
    machines = composition.cloud_of(identity).machines(identity.uid)
    found = [machine.id for machine in machines if machine.id.slot == slot]
    if not found:
        raise FogftError(
            f"no machine is running in slot {slot} of `{identity.name}`",
            slots_hint(slot, (machine.id.slot for machine in machines)),
        )
    return max(found)
