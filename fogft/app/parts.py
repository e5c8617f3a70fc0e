"""The examples, and the parts of a pool that can be run by hand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fogft.app.clouds import cloud_of, make_store


def init(example: str, into: Path | None, *, force: bool = False) -> list[Path]:
    """Write an example's files; return them, the pool file first.

    Args:
        example: Its name; empty for the default one.
        into: The folder; None for one with the example's name, here.
        force: Overwrite files that are there.

    Raises:
        FogftError: There is no such example, or a file is in the way.
    """
    from fogft.pool.commands.init import DEFAULT_EXAMPLE, copy_example

    name = example or DEFAULT_EXAMPLE
    return copy_example(name, into or Path(name), force=force)


def examples() -> Sequence[str]:
    """Return the names of the examples that `init` can write."""
    from fogft.pool.commands import init

    return list(init.examples())


def run_proxy(config: Path, *, metrics: str | None = None) -> None:
    """Run a client proxy until a signal ends it."""
    from fogft.proxy.robot import process

    process.run(config, metrics=metrics)


def run_server(
    config: Path,
    *,
    listen: str | None = None,
    domain_id: int | None = None,
    workdir: Path | None = None,
    notice_file: Path | None = None,
    advertise: str | None = None,
    metrics: str | None = None,
) -> None:
    """Run a server proxy until a signal ends it."""
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


def run_manager(pool: str, *, metrics: str | None = None) -> None:
    """Run a pool's manager until a signal ends it, or the pool has been ended."""
    from fogft.pool.manager import manager

    manager.run(make_store(pool), cloud_of, metrics=metrics)


def run_rendezvous(config: Path, *, listen: str | None = None, metrics: str | None = None) -> None:
    """Run a rendezvous until a signal ends it."""
    from fogft.pool.commands import rendezvous

    rendezvous.run(rendezvous.read_config(config, listen, metrics))


def run_gateway(config: Path, *, listen: str | None = None, metrics: str | None = None) -> None:
    """Run a gateway until a signal ends it."""
    from fogft.proxy.gateway import process

    process.run(config, listen=listen, metrics=metrics)
