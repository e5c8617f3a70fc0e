"""What a run of the quick start left on this machine: processes, shared memory, files.

Owns: what was there before, and what of the new is ours.
Not here: ending a pool (`fogft down`) and the rules by which shared memory may be removed
(`fogft.ros.shared_memory`).
"""

from __future__ import annotations

import os
import re
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

SHARED_MEMORY = Path("/dev/shm")
GRACE_S = 15.0  # after the last process ended, the kernel and the sweep get so long
# Names that only this project or its ROS processes give; other programs may run meanwhile.
_NAMES = re.compile(r"fast(dds|rtps|_datasharing)_|^lttng-ust-wait|^\.ros$|^fogft$|^fogft-local")
DOMAINS = range(20, 60)  # the tests use those from 60


@dataclass(frozen=True)
class Before:
    """The names that were there before the run, by folder."""

    names: dict[Path, frozenset[str]]

    @classmethod
    def now(cls) -> Before:
        """Look at this machine as it is."""
        home = Path.home()
        folders = (
            SHARED_MEMORY,
            Path(tempfile.gettempdir()),
            home,
            home / ".ros",
            home / ".local" / "state",
            home / ".cache",
        )
        return cls({folder: _names(folder) for folder in folders})

    def left_behind(self, fogft_home: Path) -> list[str]:
        """Return what is there now, was not before, and is ours. Waits a little for it to go."""
        from fogft.ros import shared_memory

        limit = time.monotonic() + GRACE_S
        while True:
            shared_memory.sweep()
            left = processes(fogft_home) + self._files()
            if not left or time.monotonic() > limit:
                return left
            time.sleep(0.5)

    def _files(self) -> list[str]:
        left = []
        in_use = _shared_memory_in_use()
        for folder, names in self.names.items():
            for name in sorted(_names(folder) - names):
                # What a living process uses is not ours: ours were looked for before.
                used = folder == SHARED_MEMORY and name.replace("sem.", "") in in_use
                if _NAMES.search(name) and not used:
                    left.append(str(folder / name))
        return left


def processes(fogft_home: Path) -> list[str]:
    """Return the processes of a pool under this ``FOGFT_HOME``, or of its machines."""
    marks = {f"FOGFT_HOME={fogft_home}".encode()}
    for identity in fogft_home.glob("pools/*/pool.json"):
        uid = re.search(r'"uid":\s*"([0-9a-f]{16})"', identity.read_text())
        if uid:
            marks.add(f"FOGFT_POOL_UID={uid[1]}".encode())
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        try:
            if marks & set((entry / "environ").read_bytes().split(b"\0")):
                command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode().strip()
                if command:  # an ended process that is not reaped yet has none
                    found.append(f"process {entry.name} ({command[:60]})")
        except OSError:
            continue
    return found


def free_ros_domain() -> int:
    """Return a ROS domain in which nobody listens on this machine."""
    ports = set()
    for table in ("/proc/net/udp", "/proc/net/udp6"):
        try:
            lines = Path(table).read_text().splitlines()[1:]
        except OSError:
            continue
        ports |= {int(line.split()[1].rsplit(":", 1)[1], 16) for line in lines}
    start = os.getpid() % len(DOMAINS)
    for domain in (*DOMAINS[start:], *DOMAINS[:start]):
        first = 7400 + 250 * domain
        if not any(first <= port < first + 250 for port in ports):
            return domain
    return DOMAINS[start]


def _names(folder: Path) -> frozenset[str]:
    try:
        return frozenset(os.listdir(folder))
    except OSError:
        return frozenset()


def _shared_memory_in_use() -> set[str]:
    """Return the groups of names in /dev/shm that a living process maps, with their lock files."""
    used = set()
    for maps in Path("/proc").glob("[0-9]*/maps"):
        try:
            text = maps.read_text(errors="replace")
        except OSError:
            continue
        for name in re.findall(r"/dev/shm/(?:sem\.)?(\S+)", text):
            group = re.sub(r"_(el|sl|mutex)$", "", name)
            used |= {group, *(f"{group}_{part}" for part in ("el", "sl", "mutex"))}
    return used
