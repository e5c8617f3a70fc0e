"""Clean up shared memory that killed ROS processes left in /dev/shm.

Fast DDS creates a *segment* (random name) for each participant and a *port* (named by its
number) for each port of a domain, with lock files beside them::

    fastdds_8d5e2bd0a1c7f3e4      a segment    fastdds_8d5e2bd0a1c7f3e4_el  held while it lives
    fastdds_port22911             a port       fastdds_port22911_el / _sl   held by its readers
                                               sem.fastdds_port22911_mutex  held while opening

A group of such files is removed if no process maps or holds open any of them, none of its lock
files is locked (which also covers processes that /proc hides: another container), it belongs to
this user, and nothing has touched it for `SETTLED_S`. The next process reuses a port's name, so a
port is removed under its own mutex, as Fast DDS does it.

The next process removes its predecessor's port and creates a new one. Fast DDS keeps writing to
the removed port for two seconds, and that data arrives up to three seconds later, all at once: more
than a client keeps. Fast DDS immediately reopens a port that is marked as broken.

Names begin with ``fastrtps`` before Fast DDS 3. The ROS wheels' tracing library leaves
``lttng-ust-wait-*``; the same rules apply. Needs neither rclpy nor Fast DDS.
"""

import contextlib
import ctypes
import fcntl
import os
import re
import struct
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

from fogft.process import on_thread
from fogft.ros import spdp

SETTLED_S = 2.0
FOLDER = Path("/dev/shm")
_OPEN_FLAGS = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK  # others' may be a FIFO

_TURN_LIMIT_S = 5.0
_IN_DELETE, _EVENTS_BYTES = 0x200, 1 << 16  # of inotify
_PORT_EVENT = re.compile(rb"\0fast(?:dds|rtps)_port(\d+)\0")
# A process that starts or exits removes dozens of files within a few ms: one read returns many.
_REST_S = 0.05
_STALE_S = 1.0  # this long after a check, this process may have opened other ports
_OPEN = re.compile(rb"([0-9a-f]+)-.*/fast(?:dds|rtps)_port(\d+)( \(deleted\))?")
# A port begins, in Fast DDS 2.14 and 3.2, with its number, its reader count, two limits in ms (one
# a third of the other), the counts of messages and waiters, and flags (the lowest: "not broken").
_PORT, _HEAD_BYTES = struct.Struct("=7I"), 1024
_ASIDE = "_aside"  # follows the port's name in the name of its mutex
_SET_ASIDE = re.compile(rf"(?:{_ASIDE})*_mutex$")  # repeated if a sweep was killed
_SEGMENT = re.compile(r"fast(?:dds|rtps)_[0-9a-f]{16}")
_OURS = re.compile(
    r"(?:sem\.)?(?P<group>fast(?:dds|rtps)_(?:port\d+|[0-9a-f]+)|fast_datasharing_[^/]+?"
    rf"|lttng-ust-wait-[\w-]+?)(?:_el|_sl|(?:{_ASIDE})*_mutex)?"
)


def sweep() -> list[str]:
    """Remove files that no living process uses; return their names, sorted.

    Takes tens of milliseconds. Safe to run concurrently with anything, including itself; files
    that cannot be judged stay.
    """
    with _one_at_a_time() as my_turn:
        unused = _unused() if my_turn else {}
        return sorted(_remove(set(unused))) if unused else []


@contextlib.contextmanager
def _one_at_a_time() -> Iterator[bool]:
    """Wait for other sweeps, by a lock on the folder; False if they take too long."""
    try:
        descriptor = os.open(FOLDER, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:  # no shared memory here
        yield False
        return
    deadline = time.monotonic() + _TURN_LIMIT_S
    try:
        while not (ours := _lock(descriptor)) and time.monotonic() < deadline:
            time.sleep(0.02)
        yield ours
    finally:
        os.close(descriptor)


def _lock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _unused() -> dict[str, list[str]]:
    """Return the groups of which no process of this user maps or holds open a file."""
    candidates = grouped_names()
    used = names_in_use() if candidates else set()
    return {group: names for group, names in candidates.items() if used.isdisjoint(names)}


def grouped_names() -> dict[str, list[str]]:
    """Return this user's files that are old enough, grouped by segment or port."""
    groups: dict[str, list[str]] = {}
    fresh: set[str] = set()
    now = time.time()
    for path in FOLDER.glob("*"):  # none where there is no shared memory at all
        match = _OURS.fullmatch(path.name)
        if match is None:
            continue
        try:
            status = path.lstat()
        except FileNotFoundError:
            continue
        group = match["group"]
        touched = max(status.st_mtime, status.st_ctime)
        if status.st_uid != os.getuid() or abs(now - touched) < SETTLED_S:
            fresh.add(group)
        groups.setdefault(group, []).append(path.name)
    return {group: names for group, names in groups.items() if group not in fresh}


def make_private() -> None:
    """Make this process's segments, which hold its messages, private to this user.

    Fast DDS makes them world-readable, whatever the umask. Other users' processes lose nothing:
    they would need write access to use a segment, and they use UDP as before.
    """
    for name in _mapped("self"):
        if _SEGMENT.fullmatch(name):
            with contextlib.suppress(OSError):  # another user's, or gone
                (FOLDER / name).chmod(0o600)


def break_dead_ports(domain_id: int) -> set[str]:
    """Mark a domain's ports of killed processes as broken, so that their writers reopen them.

    Otherwise a writer would keep using such a port, which nobody reads, for one more second after
    a new participant has taken its number. Returns their names.
    """
    broken, first = set[str](), spdp.first_port(domain_id)
    ports = {str(number) for number in range(first, first + spdp.DOMAIN_GAIN)}
    for path in FOLDER.glob("fast*_port*"):
        number = path.name.rpartition("port")[2]
        if number in ports and _is_ours(path) and semaphore(path.name, "sem_trywait"):
            try:
                if not any(_locked(path.name + beside) for beside in ("_el", "_sl")):
                    with contextlib.suppress(OSError), path.open("r+b", buffering=0) as memory:
                        if _mark_broken(memory.fileno(), 0, int(number)):
                            broken.add(path.name)
            finally:
                semaphore(path.name, "sem_post")
    return broken


class PortWatch:
    """Makes this process reopen each port of a domain that another removes, on a thread."""

    def __init__(self, domain_id: int) -> None:
        self._domain_id = domain_id
        self._libc, self._closed, self._id = ctypes.CDLL(None), False, -1
        with contextlib.suppress(AttributeError):  # no Linux
            self._watch = self._libc.inotify_init1(os.O_CLOEXEC)
            self._id = self._libc.inotify_add_watch(self._watch, bytes(FOLDER), _IN_DELETE)
        self._thread = on_thread(self._run, name="ros-ports")

    def _run(self) -> None:
        looked_at, (ports, _) = time.monotonic(), reopen_ports()
        while self._id >= 0 and not self._closed:
            removed = set(map(int, _PORT_EVENT.findall(os.read(self._watch, _EVENTS_BYTES))))
            domains = {spdp.domain_of(port) for port in removed}
            stale = bool(removed) and time.monotonic() - looked_at > _STALE_S
            if removed & ports or self._domain_id in domains or stale:
                looked_at, (ports, _) = time.monotonic(), reopen_ports()
            time.sleep(_REST_S)
        if self._id >= 0:
            os.close(self._watch)

    def close(self) -> None:
        """Stop it and wait until it has ended. Call it only once."""
        self._closed = True
        if self._id >= 0:
            self._libc.inotify_rm_watch(self._watch, self._id)  # this wakes the thread
        self._thread.join()


def reopen_ports() -> tuple[set[int], int]:
    """Mark removed ports that this process still has open as broken, so that it reopens them.

    Returns the ports that it has open, and how many it has marked.
    """
    ports, broken = set[int](), 0
    with contextlib.suppress(OSError), open("/proc/self/mem", "r+b", buffering=0) as memory:
        for line in Path("/proc/self/maps").read_bytes().splitlines():
            found = b"_port" in line and _OPEN.fullmatch(line)
            if found:
                ports.add(int(found[2]))
                if found[3]:
                    with contextlib.suppress(OSError):  # closed meanwhile
                        broken += _mark_broken(memory.fileno(), int(found[1], 16), int(found[2]))
    return ports, broken


def _mark_broken(memory: int, start: int, number: int) -> bool:
    head = os.pread(memory, _HEAD_BYTES, start)
    for at in range(0, len(head) - _PORT.size, 4):
        port, _, limit_ms, wait_ms, _, _, flags = _PORT.unpack_from(head, at)
        if port == number and wait_ms == limit_ms // 3 and flags & 1 and flags < 8:
            os.pwrite(memory, bytes([flags & ~1]), start + at + _PORT.size - 4)
            return True
    return False


def _mapped(process: str) -> set[str]:
    prefix, names = f"{FOLDER}/".encode(), set[str]()
    with contextlib.suppress(OSError):
        for line in Path("/proc", process, "maps").read_bytes().splitlines():
            _, found, name = line.partition(prefix)
            if found:
                names.add(name.removesuffix(b" (deleted)").decode(errors="replace"))
    return names


def names_in_use() -> set[str]:
    """Return the names in /dev/shm that a process of this user maps or holds open."""
    used: set[str] = set()
    for process in filter(str.isdigit, os.listdir("/proc")):
        used |= _mapped(process)
        with contextlib.suppress(OSError):
            descriptors = f"/proc/{process}/fd"
            for descriptor in os.listdir(descriptors):
                with contextlib.suppress(OSError):
                    target = os.readlink(f"{descriptors}/{descriptor}")
                    if target.startswith(f"{FOLDER}/"):
                        used.add(target.removeprefix(f"{FOLDER}/").removesuffix(" (deleted)"))
    return used


def _remove(unused: set[str]) -> list[str]:
    """Remove groups after a second check, made while nobody can open them as a port.

    The mutexes are held without being mapped, so that a process that waits for one shows in
    /proc. A mutex that cannot be acquired is mapped by a live process, or its holder was killed.
    Mutexes are removed last: until then they keep others from the port.
    """
    held = [group for group in unused if "_port" in group and semaphore(group, "sem_trywait")]
    going: list[str] = []
    try:
        for group, names in _unused().items():
            if group in unused and not any(map(_locked, names)):
                going += names
        removed = [name for name in going if not name.startswith("sem.") and unlink_name(name)]
        mutexes = [name for name in going if name.startswith("sem.")]
        new_names = {name: _SET_ASIDE.sub(f"{_ASIDE}_mutex", name) for name in mutexes}
        used = _set_aside(new_names)
    finally:
        for group in held:  # if ours was set aside, another may have been created by now
            aside = _ASIDE if f"sem.{group}_mutex" in going else ""
            semaphore(group + aside, "sem_post")
    return removed + [name for name in mutexes if unlink_name(new_names[name]) and name not in used]


def _set_aside(new_names: Mapping[str, str]) -> set[str]:
    """Rename mutexes, and restore those that a process waits for; return the latter.

    Otherwise the next process to open the port would not wait for that one. Both would create the
    port, and the loser would leave the winner without its file for good: each ROS process that
    starts afterwards prints `Failed init_port`.
    """
    for name, aside in new_names.items():
        with contextlib.suppress(OSError):
            (FOLDER / name).rename(FOLDER / aside)  # nobody can reach it any more
    in_use = names_in_use() if new_names else set()
    used = {name for name, aside in new_names.items() if aside in in_use}
    for name in used:
        with contextlib.suppress(OSError):  # another has been created
            os.link(FOLDER / new_names[name], FOLDER / name)
    return used


def unlink_name(name: str) -> bool:
    """Remove a file; return whether that worked."""
    try:
        (FOLDER / name).unlink()
    except OSError:
        return False
    return True


def semaphore(group: str, operation: str) -> bool:
    """Call an operation on a port's POSIX semaphore; return whether it exists and that worked."""
    libc = ctypes.CDLL(None)
    libc.sem_open.restype = ctypes.c_void_p
    opened = libc.sem_open(f"/{group}_mutex".encode(), 0)
    if not opened:  # SEM_FAILED
        return False
    try:
        return bool(getattr(libc, operation)(ctypes.c_void_p(opened)) == 0)
    finally:
        libc.sem_close(ctypes.c_void_p(opened))


def _is_ours(path: Path) -> bool:
    """Whether a file is this user's, and no link: others can plant what we would write to."""
    try:
        return path.lstat().st_uid == os.getuid()
    except FileNotFoundError:
        return False


def _locked(name: str) -> bool:
    """Whether any process, even one hidden from us, holds a lock on a lock file."""
    if not name.endswith(("_el", "_sl")):
        return False
    try:
        descriptor = os.open(FOLDER / name, _OPEN_FLAGS)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    try:
        return not _lock(descriptor)
    finally:
        os.close(descriptor)  # frees the lock
