"""Checks of this machine: the installation, disk, shared memory, ports, the clock."""

import os
import platform
import shutil
import socket
import sys
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path

import fogft
from fogft.doctor.finding import Finding, Situation, fail, ok, warn
from fogft.model.names import LINK_PORT

_SHARED_MEMORY = Path("/dev/shm")
# Each process maps a segment of the shipped Fast DDS profile, and a pool has a handful.
_SHARED_MEMORY_WANTED_BYTES = 256 << 20
_DISK_WANTED_BYTES = 200 << 20


def installation(_: Situation) -> Iterator[Finding]:
    """fogft is installed, and the command is on the PATH."""
    where = Path(fogft.__file__).parent
    text = f"fogft {fogft.__version__} at {where}, on Python {platform.python_version()}"
    if shutil.which("fogft") is None:
        beside = Path(sys.executable).parent
        yield warn(
            "fogft",
            f"{text}: `fogft` is not on PATH",
            f"activate the virtual environment, or add {beside} to PATH",
        )
    else:
        yield ok("fogft", text)


def state_folder(situation: Situation) -> Iterator[Finding]:
    """The state folder can be written, is private, and its disk has room."""
    home = situation.home
    existing = next(p for p in (home, *home.parents) if p.exists())
    if not os.access(existing, os.W_OK | os.X_OK):
        yield fail(
            "state folder",
            f"`{home}` cannot be written",
            f"change the owner of `{existing}`, or set FOGFT_HOME to another folder",
        )
        return
    if home.exists() and home.stat().st_mode & 0o077:
        yield warn(
            "state folder",
            f"`{home}` can be read by other users; it holds private keys",
            f"run `chmod 700 {home}`",
        )
    free = shutil.disk_usage(existing).free
    if free < _DISK_WANTED_BYTES:
        yield warn(
            "state folder",
            f"only {_megabytes(free)} free at `{existing}`",
            "free some disk space: logs and credentials are written there",
        )
    else:
        yield ok("state folder", f"`{home}`, {_megabytes(free)} free")


def shared_memory(_: Situation) -> Iterator[Finding]:
    """/dev/shm, which ROS uses for shared memory, has free space."""
    advice = "in a container, start it with `--shm-size=1g` (or `--ipc=host`)"
    if not _SHARED_MEMORY.is_dir() or not os.access(_SHARED_MEMORY, os.W_OK):
        yield fail("shared memory", "there is no writable /dev/shm", advice)
        return
    usage = shutil.disk_usage(_SHARED_MEMORY)
    text = f"{_megabytes(usage.free)} of {_megabytes(usage.total)} free in /dev/shm"
    if usage.free < 1 << 20:
        left = "`fogft down` removes leftovers of killed ROS processes"
        yield fail("shared memory", f"{text}: ROS nodes may die with SIGBUS", f"{left}; {advice}")
    elif usage.free < _SHARED_MEMORY_WANTED_BYTES:
        yield warn("shared memory", f"only {text}; large messages will be slow", advice)
    else:
        yield ok("shared memory", text)


def ports(_: Situation) -> Iterator[Finding]:
    """The default port of a server proxy is free."""
    try:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("0.0.0.0", LINK_PORT))
    except OSError:
        yield warn(
            "ports",
            f"TCP port {LINK_PORT}, the default of `fogft serve`, is in use",
            "pass `--listen HOST:PORT` when you run `fogft serve` here; pools on the local "
            "cloud pick free ports",
        )
    else:
        yield ok("ports", f"TCP port {LINK_PORT} is free")


def clock(situation: Situation) -> Iterator[Finding]:
    """The clock is not in the past."""
    built = max(p.stat().st_mtime for p in Path(fogft.__file__).parent.rglob("*.py"))
    shown = datetime.fromtimestamp(situation.now, timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC")
    if situation.now < built - 86400:
        yield fail(
            "clock",
            f"the clock says {shown}, which is before fogft was installed",
            "set the clock, for example with `sudo timedatectl set-ntp true`",
        )
    else:
        yield ok("clock", shown)


def _megabytes(size: float) -> str:
    return f"{size / 2**30:.1f} GiB" if size >= 2**30 else f"{size / 2**20:.0f} MiB"
