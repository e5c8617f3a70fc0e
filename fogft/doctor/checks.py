"""All checks, in the order in which a person would look."""

import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from fogft.doctor import machine, pools, ros
from fogft.doctor.finding import Check, Finding, Situation, run
from fogft.pool.commands import composition
from fogft.pool.folder.paths import home
from fogft.poolfile.file import read

ALL: tuple[Check, ...] = (
    *(machine.installation, machine.state_folder, machine.shared_memory, machine.ports),
    *(machine.clock, ros.rclpy, ros.domain, ros.profile, ros.discovery),
    *(pools.orphaned_processes, pools.chaos, pools.pool_file, pools.certificates, pools.processes),
)


def examine(file: Path | None = None) -> Iterator[Finding]:
    """Check this machine, ROS 2, a pool file and the pools here; yield findings as they come."""
    spec = None if file is None else read(file)
    pools_here: tuple[str, ...] = ()
    with suppress(OSError):  # `machine.state_folder` reports it
        pools_here = tuple(composition.pools())
    for check in ALL:  # some take seconds, and a report's age is relative to now
        yield from run(check, Situation(home(), pools_here, spec, time.time()))
