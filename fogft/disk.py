"""Files shared between processes: replaced atomically, private, locked by the kernel (flock).

Errors: StateError.
"""

import contextlib
import errno
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

from fogft import poll
from fogft.errors import StateError
from fogft.model.plain import stored

if sys.platform != "win32":  # where files are only read and written by one process
    import fcntl

_PATIENCE_S = 0.2
_ENDING_S = 1.0
_PID_BYTES = 20
_ROOM_BYTES = 64 << 10  # for a status file
T = TypeVar("T")


def make_folder(path: Path) -> None:
    """Create a folder that only this user can enter, with its parents."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        hint = "check the disk and the owner, or set FOGFT_HOME to another folder"
        raise StateError(f"`{path}` cannot be created: {error.strerror}", hint) from error
    with contextlib.suppress(OSError):
        path.chmod(0o700)


def write_whole(path: Path, content: bytes | str, *, durable: bool = True) -> None:
    """Replace a file at once, or leave it; 0600; `durable`: survives a power cut (one fsync)."""
    data = content.encode() if isinstance(content, str) else content
    os.close(_replaced(path, data, durable=durable))


def _replaced(path: Path, data: bytes, *, durable: bool) -> int:
    temporary = ""
    try:
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(descriptor, "wb", closefd=False) as file:
            file.write(data)
        if durable:
            os.fsync(descriptor)
        os.replace(temporary, path)
    except OSError as error:
        if temporary:
            os.close(descriptor)
            with contextlib.suppress(OSError):
                os.unlink(temporary)
        raise not_done("written", path, error) from error
    return descriptor


def write_json(path: Path, value: Any, *, durable: bool = True) -> None:
    """Replace a file with a value as JSON, on one line where it is not durable."""
    # Indented it takes ten times as long.
    write_whole(path, to_json(value) if durable else json.dumps(value), durable=durable)


class Report:
    """A JSON file that says how things are now, also where nothing else can be written.

    Then the last one, which stays open, is written over: a reader may then find it damaged.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._open: int | None = None

    def write(self, value: Any) -> None:
        """Replace the file."""
        data = json.dumps(value).encode()
        try:
            new = _replaced(self._path, data, durable=False)
        except StateError:
            if not self._written_over(data):
                raise
        else:
            self.close()
            self._open = new

    def _written_over(self, data: bytes) -> bool:
        """Write over the file, with spaces up to its end; return whether there was room for it."""
        with contextlib.suppress(OSError):
            if self._open is None:
                self._open = os.open(self._path, os.O_RDWR | os.O_CLOEXEC)
            old = os.fstat(self._open)
            if os.path.samestat(old, self._path.stat()) and len(data) <= old.st_blocks * 512:
                return os.pwrite(self._open, data.ljust(old.st_size), 0) >= len(data)
        return False

    def close(self) -> None:
        """Close the last one. Repeatable."""
        if self._open is not None:
            os.close(self._open)
            self._open = None


def to_json(value: Any) -> str:
    """Return a value as the text that `write_json` writes."""
    return json.dumps(value, indent=1) + "\n"


def read_bytes(path: Path) -> bytes | None:
    """Return what a file holds, or None where there is none."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:  # a folder, a link to itself, another user's
        hint = "move it away, or let this user read it"
        raise StateError(f"`{path}` cannot be read: {error.strerror}", hint) from error


def read_json(path: Path, hint: str = "") -> Any:
    """Return what a JSON file holds, or None where there is no file."""
    raw = read_bytes(path)
    if raw is None:
        return None
    try:
        return json.loads(raw.decode())
    except (ValueError, RecursionError) as error:
        raise StateError(f"`{path}` is damaged: {error}", hint) from error


def read_as(cls: type[T], path: Path, hint: str = "") -> T | None:
    """Return the value that a JSON file of ours describes, or None where there is no file."""
    raw = read_json(path, hint)
    return None if raw is None else stored(cls, raw, f"`{path}` is damaged", hint)


def read_or(path: Path, otherwise: T) -> T:
    """Return the same; another value of that class where there is no file, or a damaged one."""
    try:
        return read_as(type(otherwise), path) or otherwise
    except StateError:
        return otherwise


class Lock:
    """An exclusive lock on a file, which says its holder, until `release` or the process ends."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor: int | None = None

    def acquire(self, *, wait: bool) -> bool:
        """Take the lock; without `wait`, return False where another keeps it. Raises OSError."""
        # `is_locked` holds it for an instant, so one refusal proves nothing.
        until = time.monotonic() + _PATIENCE_S
        while not self.take(fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB):
            if time.monotonic() > until:
                return False
            time.sleep(0.01)
        assert self._descriptor is not None
        _wait_for_end(self._descriptor)
        with contextlib.suppress(OSError):  # no room: then it says nothing
            os.ftruncate(self._descriptor, 0)
            os.pwrite(self._descriptor, str(os.getpid()).encode(), 0)
        return True

    def take(self, how: int) -> bool:
        """Call flock; return False where it is told not to wait, and would have to."""
        creates = 0 if how & fcntl.LOCK_SH else os.O_CREAT
        try:
            descriptor = os.open(self._path, os.O_RDWR | creates | os.O_CLOEXEC, 0o600)
        except OSError as error:
            if error.errno != errno.EROFS:
                raise
            descriptor = os.open(self._path, os.O_RDONLY | os.O_CLOEXEC)  # that will do
        try:
            fcntl.flock(descriptor, how)
        except BlockingIOError:
            os.close(descriptor)
            return False
        if self._was_replaced(descriptor):
            os.close(descriptor)
            return self.take(how)
        self._descriptor = descriptor
        return True

    def _was_replaced(self, descriptor: int) -> bool:
        """Whether the file was removed, while we waited, and made anew."""
        ours = os.fstat(descriptor)
        try:
            return not ours.st_nlink and not os.path.samestat(ours, self._path.stat())
        except FileNotFoundError:
            return False

    @property
    def lost(self) -> bool:
        """Whether its file was removed while we hold it: another may hold that of a new one."""
        if self._descriptor is None or os.fstat(self._descriptor).st_nlink:
            return False
        return not self._path.exists() or self._was_replaced(self._descriptor)

    def release(self) -> None:
        """Give the lock back. Repeatable."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)


def _wait_for_end(descriptor: int) -> None:
    """Wait until a killed process that had this lock has ended completely.

    The kernel frees one lock after the other, and this one may come before those of DDS.
    """
    # Some Pythons lack `pidfd_open`.
    with contextlib.suppress(OSError, ValueError, AttributeError), contextlib.ExitStack() as stack:
        pid = int(os.pread(descriptor, _PID_BYTES, 0))
        if not is_running(pid):
            process = os.pidfd_open(pid)
            stack.callback(os.close, process)
            poll.is_ready(process, _ENDING_S)


def is_running(pid: int) -> bool:
    """Whether a process has not begun to end: then it has no memory any more."""
    with contextlib.suppress(OSError):
        return any(map(int, Path(f"/proc/{pid}/statm").read_bytes().split()))
    return False


def standby_lock(path: Path) -> Path:
    """Return the lock that the next holder of a lock waits with."""
    return path.with_name(f"{path.stem}-standby{path.suffix}")


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a lock for a while; wait for it."""
    lock = Lock(path)
    try:
        lock.acquire(wait=True)
    except OSError as error:
        raise not_done("opened", path, error) from error
    try:
        yield
    finally:
        lock.release()


def is_locked(path: Path) -> bool:
    """Return whether a living process holds the lock of this file."""
    lock = Lock(path)
    try:
        if not lock.take(fcntl.LOCK_SH | fcntl.LOCK_NB):
            return True
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:
        raise not_done("opened", path, error) from error
    lock.release()
    return False


def not_done(what: str, path: Path, error: OSError) -> StateError:
    """Return the error for a file of ours that cannot be opened or written (`what`)."""
    hint = "check the disk's free space and the folder's owner"
    return StateError(f"`{path}` cannot be {what}: {error.strerror}", hint)


def holder(lock: Path, *, said: bool = True) -> int | None:
    """Return the process that holds a lock; None for nobody.

    By the kernel's own list; in a container, where it may name another device, by what the holder
    wrote, if that is to be believed (`said`).
    """
    try:
        stat = lock.stat()
        lines = Path("/proc/locks").read_text().splitlines()
    except OSError:
        return None
    wanted = f"{os.major(stat.st_dev):02x}:{os.minor(stat.st_dev):02x}:{stat.st_ino}"
    for line in lines:
        fields = line.split()
        # READ is one that only looks whether it is locked.
        if len(fields) >= 6 and fields[1:4:2] == ["FLOCK", "WRITE"] and fields[5] == wanted:
            pid = int(fields[4])
            return pid if pid > 0 else None
    return said_holder(lock) if said and is_locked(lock) else None


def said_holder(lock: Path) -> int | None:
    """Return the process that wrote last that it holds a lock; None if none has."""
    with contextlib.suppress(OSError, ValueError):
        return max(0, int(lock.read_text())) or None
    return None


def unwritable(folder: Path) -> str:
    """Say why a folder's disk takes nothing more, `full` or `read-only`; else empty."""
    try:
        seen = os.statvfs(folder)
    except OSError:
        return ""  # it has just been removed
    if seen.f_flag & os.ST_RDONLY:
        return "read-only"
    no_room = seen.f_bavail * seen.f_frsize < _ROOM_BYTES or (seen.f_files and not seen.f_favail)
    return "full" if no_room else ""


def version(path: Path) -> tuple[int, int, int] | None:
    """Return what differs once a file was replaced or written; None where there is none."""
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_ino, stat.st_size


class Watched:
    """Watches a file for being replaced; what is there `from_now` on is no change."""

    def __init__(self, path: Path, *, from_now: bool = False) -> None:
        self.path = path
        self._seen = version(path) if from_now else None

    def changed(self) -> bool:
        """Return whether the file is there and is not the one seen at the last call."""
        found, before = version(self.path), self._seen
        self._seen = found or before
        return found not in (None, before)

    def forget(self) -> None:
        """Take the file for one not seen yet: what was there could not be used."""
        self._seen = None
