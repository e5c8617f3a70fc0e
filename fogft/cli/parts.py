"""Run one part of a pool in the foreground, or let systemd do so."""

import importlib.util
from pathlib import Path
from typing import Annotated

import typer

from fogft.cli import output
from fogft.cli.commands import Command, group
from fogft.cli.options import PoolName, PoolOption
from fogft.errors import FogftError
from fogft.model.choices import Speaks
from fogft.pool.commands import composition
from fogft.pool.commands import service as units


def _endpoint(value: str | None) -> str | None:
    from fogft.model.names import is_endpoint

    if value is not None and not is_endpoint(value):
        raise typer.BadParameter(f"`{value}` is not HOST:PORT, such as 127.0.0.1:9464")
    return value


Listen = Annotated[
    str | None,
    typer.Option(metavar="HOST:PORT", help="Address to listen on; by default the one in the file."),
]

Config = Annotated[
    Path, typer.Option("--config", "-c", metavar="FILE", help="Configuration file (YAML).")
]

Metrics = Annotated[
    str | None,
    typer.Option(
        metavar="HOST:PORT",
        help="Address to serve Prometheus metrics on (GET /metrics).",
        callback=_endpoint,
    ),
]


def proxy(
    config: Config,
    metrics: Metrics = None,
    *,
    standby: Annotated[
        bool,
        typer.Option(
            "--standby", help="Wait while another proxy runs, and take over when it ends."
        ),
    ] = False,
    spare: Annotated[
        bool, typer.Option("--spare", help="The same; where one waits already, wait behind it.")
    ] = False,
) -> None:
    """Run a client proxy: the robot's side of a pool.

    The manager writes its configuration to the pool's state folder as `proxy.yaml`.
    """
    from fogft.proxy.robot import process

    process.run(config, metrics=metrics, standby=standby, spare=spare)


def serve(
    config: Config,
    *,
    listen: Listen = None,
    domain_id: Annotated[
        int | None, typer.Option(min=0, max=232, metavar="N", help="ROS domain of the service.")
    ] = None,
    workdir: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder to start the `run` command in.")
    ] = None,
    notice_file: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File that appears before this machine is preempted."),
    ] = None,
    advertise: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT", help="Address at which others reach it, if it is behind NAT."
        ),
    ] = None,
    metrics: Metrics = None,
) -> None:
    """Run a server proxy: a replica's side of a pool.

    Starts the pool file's `run` command and restarts it when it exits.
    """
    from fogft.proxy.replica import process

    process.run(
        config,
        listen=listen,
        domain_id=domain_id,
        workdir=workdir,
        notice_file=notice_file,
        advertise=advertise,
        metrics=metrics,
    )


def manager(
    pool: PoolName,
    *,
    metrics: Metrics = None,
    no_proxy: Annotated[
        bool,
        typer.Option(
            "--no-proxy", help="Do not start a client proxy, for example because systemd does."
        ),
    ] = False,
) -> None:
    """Run a pool's manager: it observes the pool, plans and launches."""
    from fogft.pool.manager.manager import run

    run(
        composition.make_store(pool),
        composition.cloud_of,
        metrics=metrics,
        keeps_proxy=not no_proxy,
    )


def rendezvous(config: Config, listen: Listen = None, metrics: Metrics = None) -> None:
    """Run a rendezvous, where robots and replicas find each other.

    Needs a port that every member can reach, and carries no requests. Run two, on two machines.
    """
    from fogft.pool.commands.rendezvous import run

    run(config, listen=listen, metrics=metrics)


def gateway(config: Config, listen: Listen = None, metrics: Metrics = None) -> None:
    """Run a gateway: robots ask it once, and it asks the replicas.

    Run it where bandwidth is ample: on its own machine, or on a replica's.
    """
    from fogft.proxy.gateway import process

    process.run(config, listen=listen, metrics=metrics)


System = Annotated[
    bool, typer.Option("--system", help="System units instead of user units; needs root.")
]
Gateway = Annotated[
    Path | None,
    typer.Option(
        "--gateway", metavar="FILE", help="Units of a gateway with this configuration instead."
    ),
]
Rendezvous = Annotated[
    Path | None,
    typer.Option(
        "--rendezvous",
        metavar="FILE",
        help="Units of a rendezvous with this configuration instead.",
    ),
]

service = group("Let systemd start a pool's processes at boot, and restart them.")


def _units(
    pool: str | None, gateway: Path | None, rendezvous: Path | None, *, system: bool
) -> list[units.Unit]:
    for part, config in (("gateway", gateway), ("rendezvous", rendezvous)):
        if config is not None:
            return units.of_part(part, config, system=system)
    return units.of_pool(composition.paths_of(pool), system=system)


@service.command(cls=Command, epilog="fogft service install")
def install(
    *,
    pool: PoolOption = None,
    gateway: Gateway = None,
    rendezvous: Rendezvous = None,
    system: System = False,
) -> None:
    """Install and start units for the manager and three client proxies.

    Units get the current environment, so source ROS 2 first. Running processes hand over.
    """
    where = units.Services(system)
    wanted = _units(pool, gateway, rendezvous, system=system)
    paths = None if gateway or rendezvous else composition.paths_of(pool)
    refused = units.install(where, wanted, paths)
    for unit in wanted:
        output.data(str(where.folder / unit.name))
    if refused:
        raise FogftError(
            f"the units are written, but systemd did not start them: {'; '.join(refused)}",
            "repeat this once your own systemd runs (`loginctl enable-linger`), or use `--system`",
        )
    if paths is not None:
        units.hand_over(paths)
        speaks = composition.store_of(pool).spec().rmw.robot
        if speaks is Speaks.RCLPY and importlib.util.find_spec("rclpy") is None:
            output.warn("the units have no ROS 2: source it and repeat (`sudo -E` drops its paths)")
    output.done("systemd starts them at boot, and restarts any that die")
    if not system:
        output.hint("`loginctl enable-linger` starts them before you log in")


@service.command(cls=Command, epilog="fogft service status")
def status(*, system: System = False) -> None:
    """Show the units and their state."""
    where = units.Services(system)
    found = units.installed(where)
    for name, state in units.states(where, found).items():
        output.data(f"{name}  {state}")
    if not found:
        output.say(f"no units are installed in {where.folder}")


@service.command(cls=Command, epilog="fogft service remove")
def remove(
    *,
    pool: PoolOption = None,
    gateway: Gateway = None,
    rendezvous: Rendezvous = None,
    system: System = False,
) -> None:
    """Stop and delete the units. Replicas keep running; `fogft up` starts a manager."""
    where = units.Services(system)
    if pool is not None:  # the pool may have ended
        names = list(units.names_of(pool).values())
    else:
        names = [unit.name for unit in _units(pool, gateway, rendezvous, system=system)]
    found = units.installed(where, names)
    if refused := units.remove(where, found):
        output.warn(f"systemd did not stop them: {refused}")
    output.done(f"removed {', '.join(found)}" if found else "nothing was installed")
