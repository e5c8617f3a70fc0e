"""``fogft check | plan | bake``: a pool file's mistakes, what it would launch, and its image."""

from pathlib import Path
from typing import Annotated

import typer

from fogft.cli import output
from fogft.cli.options import DEFAULT_FILE, AsJson, Cloud, Plot, PoolFile


def plan(  # noqa: PLR0917 - Typer reads the command line from them
    file: PoolFile = DEFAULT_FILE,
    cloud: Cloud = None,
    prices: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Take prices from a CSV file in SkyPilot's format."),
    ] = None,
    offline: Annotated[
        bool, typer.Option("--offline", help="Use known round trips; do not measure.")
    ] = False,
    everything: Annotated[
        bool, typer.Option("--all", help="Show every offer, and which clouds can run such a pool.")
    ] = False,
    as_json: AsJson = False,
    plot: Plot = None,
) -> None:
    """Show what a pool file would launch, where, why, and at what price.

    LOST is an estimate, from the pool's history, of how often a spot machine is lost there.
    """
    from fogft.cli import plan_text
    from fogft.cli.screens import plan_plot
    from fogft.pool.commands.plan import plan_file
    from fogft.reason_words import words
    from fogft.simulation.plot import check

    if plot is not None:
        check(plot)
    shown = plan_file(file, cloud, prices=prices, offline=offline, told=output.say)
    if as_json:
        output.json_data(plan_text.to_json(shown))
    else:
        plan_text.show(shown, everything=everything)
    for note in (*shown.notes, *map(words, shown.explanation.notes)):
        output.warn(note)
    if plot is not None:
        plan_plot.draw(shown, plot)
        output.done(f"wrote `{plot}`")


def bake(
    tag: Annotated[str, typer.Option(metavar="IMAGE", help="Name of the image, as in a registry.")],
    file: PoolFile = DEFAULT_FILE,
    base: Annotated[
        str | None,
        typer.Option("--from", metavar="IMAGE", help="Base image, in place of the file's own."),
    ] = None,
    push: Annotated[bool, typer.Option("--push", help="Also push it to its registry.")] = False,
) -> None:
    """Build a Docker image with a pool's setup already done.

    Replicas that start from it are ready sooner: they use what fits and set up the rest.
    """
    from fogft.pool.commands.bake import bake as build

    build(file, tag, base, push=push)
    output.done(f"built `{tag}`: write `image_id: docker:{tag}` under `resources`")


def check(file: PoolFile = DEFAULT_FILE, as_json: AsJson = False) -> None:
    """Check a pool file and list all mistakes.

    Looks up the services' types on this machine. Exits with 1 if there are mistakes.
    """
    from fogft.pool.commands.preview import mistakes

    found = mistakes(file)
    if as_json:
        keys = ("line", "key", "message", "hint")
        output.json_data([{key: getattr(one, key) for key in keys} for one in found])
    for one in () if as_json else found:
        output.data(one.message + (f"\n    {one.hint}" if one.hint else ""))
    if not found:
        output.done(f"`{file}` is valid")
        return
    output.say(f"\n{len(found)} {'mistake' if len(found) == 1 else 'mistakes'} in `{file}`")
    raise typer.Exit(1)
