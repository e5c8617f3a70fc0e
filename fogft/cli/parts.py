"""Run one part of a pool in the foreground: proxy, serve, manager, rendezvous or gateway.

`fogft up` starts what a pool needs. These are for a service manager, a container or a debugger.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fogft.cli import options


def _endpoint(value: str | None) -> str | None:
    from fogft.model.names import is_endpoint

    if value is not None and not is_endpoint(value):
        raise typer.BadParameter(f"`{value}` is not HOST:PORT, such as 127.0.0.1:9464")
    return value


Listen = Annotated[
    str | None,
    typer.Option(metavar="HOST:PORT", help="Where to listen; by default as the file says."),
]

Config = Annotated[
    Path, typer.Option("--config", "-c", metavar="FILE", help="Its configuration (YAML).")
]

Metrics = Annotated[
    str | None,
    typer.Option(
        metavar="HOST:PORT",
        help="Where to serve metrics for Prometheus (GET /metrics).",
        callback=_endpoint,
    ),
]


def proxy(config: Config, metrics: Metrics = None) -> None:
    """Run a client proxy: the robot's side of a pool.

    The manager writes its configuration to the pool's state folder as `proxy.yaml`.
    """
    from fogft.proxy.robot import process

    process.run(config, metrics=metrics)


def serve(
    config: Config,
    *,
    listen: Listen = None,
    domain_id: Annotated[
        int | None, typer.Option(min=0, max=232, metavar="N", help="ROS domain of the service.")
    ] = None,
    workdir: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Where to start the `run` command.")
    ] = None,
    notice_file: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A file that appears before this machine is preempted."),
    ] = None,
    advertise: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="Where others reach it, when it is behind NAT."),
    ] = None,
    metrics: Metrics = None,
) -> None:
    """Run a server proxy: a replica's side of a pool.

    It starts the pool file's `run` command and restarts it when it dies.
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
    pool: Annotated[
        str, typer.Argument(metavar="POOL", help="Its name.", autocompletion=options.pools)
    ],
    metrics: Metrics = None,
) -> None:
    """Run a pool's manager: it observes, plans and applies."""
    from fogft.pool.commands import composition
    from fogft.pool.manager.manager import run

    run(composition.make_store(pool), composition.cloud_of, metrics=metrics)


def rendezvous(config: Config, listen: Listen = None, metrics: Metrics = None) -> None:
    """Run a rendezvous, where robots and replicas find each other.

    It needs a port that all can reach and carries no requests. Run two, on two machines.
    """
    from fogft.pool.commands.rendezvous import read_config, run

    run(read_config(config, listen, metrics))


def gateway(config: Config, listen: Listen = None, metrics: Metrics = None) -> None:
    """Run a gateway: robots ask it once, and it asks the replicas.

    Run it where the uplink is wide: on a machine of its own, or on a replica's.
    """
    from fogft.proxy.gateway import process

    process.run(config, listen=listen, metrics=metrics)
