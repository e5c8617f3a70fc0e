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
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from fogft import poll
from fogft.errors import StateError
from fogft.model.plain import stored

if sys.platform != "win32":  # on Windows only one process uses the files
    import fcntl

_TRIES = 20
_LOOKS = 3
_ENDING_S = 1.0
_PID_BYTES = 20
_ROOM_BYTES = 64 << 10  # for a status file
T = TypeVar("T")


def make_folder(path: Path) -> None:
    """Create a folder that only this user can enter, with its parents."""
    try:
        made = [path, *(parent for parent in path.parents if not parent.exists())]
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        hint = "check the disk and the owner, or set FOGFT_HOME to another folder"
        raise StateError(f"`{path}` cannot be created: {error.strerror}", hint) from error
    for folder in made:
        with contextlib.suppress(OSError):
            folder.chmod(0o700)


def write_whole(path: Path, content: bytes | str, *, durable: bool = True) -> None:
    """Replace a file atomically, mode 0600; `durable`: it survives a power cut (one fsync)."""
    data = content.encode() if isinstance(content, str) else content
    write_together({path: data}, durable=durable)


def write_together(files: Mapping[Path, bytes], *, durable: bool = True) -> None:
    """Replace files as `write_whole` does, one after another, once all are on the disk."""
    made: dict[Path, str] = {}
    try:
        for path, data in files.items():
            descriptor, made[path] = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
                if durable:
                    file.flush()
                    os.fsync(descriptor)
        for path, temporary in made.items():
            os.replace(temporary, path)
    except OSError as error:
        for temporary in made.values():
            with contextlib.suppress(OSError):
                os.unlink(temporary)
        raise not_done("written", path, error) from error


def write_json(path: Path, value: Any, *, durable: bool = True) -> None:
    """Replace a file with a value as JSON: indented if `durable`, else on one line."""
    # Indentation takes ten times as long.
    write_whole(path, to_json(value) if durable else json.dumps(value), durable=durable)


class Report:
    """A JSON file with what is current, updated even when the disk takes no new file.

    In that case the previous file, kept open, is overwritten: a reader may then find it damaged.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._open: int | None = None

    def write(self, value: Any) -> None:
        """Replace the file."""
        data = json.dumps(value).encode()
        try:
            write_whole(self._path, data, durable=False)
        except StateError:
            if not self._written_over(data):
                raise
        else:
            self.close()
            with contextlib.suppress(OSError):
                self._open = os.open(self._path, os.O_RDWR | os.O_CLOEXEC)

    def _written_over(self, data: bytes) -> bool:
        """Overwrite the file in place, padded with spaces; return whether the data fitted."""
        with contextlib.suppress(OSError):
            if self._open is None:
                self._open = os.open(self._path, os.O_RDWR | os.O_CLOEXEC)
            old = os.fstat(self._open)
            if os.path.samestat(old, self._path.stat()) and len(data) <= old.st_blocks * 512:
                return os.pwrite(self._open, data.ljust(old.st_size), 0) >= len(data)
        return False

    def close(self) -> None:
        """Close the file that is kept open. Repeatable."""
        if self._open is not None:
            os.close(self._open)
            self._open = None


def to_json(value: Any) -> str:
    """Return a value as the text that `write_json` writes."""
    return json.dumps(value, indent=1) + "\n"


def read_bytes(path: Path) -> bytes | None:
    """Return a file's content, or None if there is no file."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:  # a folder, a link to itself, another user's file
        hint = "move it away, or let this user read it"
        raise StateError(f"`{path}` cannot be read: {error.strerror}", hint) from error


def read_json(path: Path, hint: str = "") -> Any:
    """Return the parsed content of a JSON file, or None if there is no file."""
    raw = read_bytes(path)
    if raw is None:
        return None
    try:
        return json.loads(raw.decode())
    except (ValueError, RecursionError) as error:
        raise StateError(f"`{path}` is damaged: {error}", hint) from error


def read_as(cls: type[T], path: Path, hint: str = "") -> T | None:
    """Return the value stored in one of fogft's JSON files, or None if there is no file."""
    raw = read_json(path, hint)
    return None if raw is None else stored(cls, raw, f"`{path}` is damaged", hint)


def read_or(path: Path, otherwise: T) -> T:
    """Return the stored value, or `otherwise` if the file is missing or damaged."""
    try:
        return read_as(type(otherwise), path) or otherwise
    except StateError:
        return otherwise


class Lock:
    """An exclusive lock on a file, which names its holder, until `release` or process exit."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor: int | None = None

    def acquire(self, *, wait: bool) -> bool:
        """Take the lock; without `wait`, return False if another process has it. Raises OSError."""
        # `is_locked` holds the lock for an instant, so one refusal proves nothing.
        for _ in range(_TRIES):
            if self.take(fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB):
                break
            time.sleep(0.01)
        else:
            return False
        assert self._descriptor is not None
        _wait_for_end(self._descriptor)
        with contextlib.suppress(OSError):  # disk full: then the file names nobody
            os.ftruncate(self._descriptor, 0)
            os.pwrite(self._descriptor, str(os.getpid()).encode(), 0)
        return True

    def take(self, how: int) -> bool:
        """Call flock; return False if `how` is non-blocking and the lock is taken."""
        creates = 0 if how & fcntl.LOCK_SH else os.O_CREAT
        try:
            descriptor = os.open(self._path, os.O_RDWR | creates | os.O_CLOEXEC, 0o600)
        except OSError as error:
            if error.errno != errno.EROFS:
                raise
            descriptor = os.open(self._path, os.O_RDONLY | os.O_CLOEXEC)  # enough for flock
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
        """Whether the lock file was removed and recreated while we waited."""
        ours = os.fstat(descriptor)
        try:
            return not ours.st_nlink and not os.path.samestat(ours, self._path.stat())
        except FileNotFoundError:
            return False

    @property
    def lost(self) -> bool:
        """Whether the lock file was removed while held: another process may hold a new one."""
        if self._descriptor is None or os.fstat(self._descriptor).st_nlink:
            return False
        return not self._path.exists() or self._was_replaced(self._descriptor)

    def release(self) -> None:
        """Release the lock. Repeatable."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)


def _wait_for_end(descriptor: int) -> None:
    """Wait until a killed process that had this lock has ended completely.

    The kernel releases its locks one by one, and may release this one before those of DDS.
    """
    # Some Pythons lack `pidfd_open`.
    with contextlib.suppress(OSError, ValueError, AttributeError), contextlib.ExitStack() as stack:
        pid = int(os.pread(descriptor, _PID_BYTES, 0))
        if not is_running(pid):
            process = os.pidfd_open(pid)
            stack.callback(os.close, process)
            poll.is_ready(process, _ENDING_S)


def is_running(pid: int) -> bool:
    """Whether a process is alive: one that has begun to exit has no memory left."""
    with contextlib.suppress(OSError):
        return any(map(int, Path(f"/proc/{pid}/statm").read_bytes().split()))
    return False


def standby_lock(path: Path) -> Path:
    """Return the lock that a standby holds while it waits for another lock."""
    return path.with_name(f"{path.stem}-standby{path.suffix}")


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Wait for a lock and hold it within the `with` block."""
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
    """Return the error for a file of fogft's that cannot be opened or written (`what`)."""
    hint = "check the disk's free space and the folder's owner"
    return StateError(f"`{path}` cannot be {what}: {error.strerror}", hint)


def holder(lock: Path, *, said: bool = True) -> int | None:
    """Return the pid of the process that holds a lock, or None.

    Taken from the kernel's list; in a container, where that may name another device, from what
    the holder wrote into the file, if that may be trusted (`said`).
    """
    for _ in range(_LOOKS):  # a list in several pages lacks some if others end meanwhile
        pid = _listed(lock)
        if pid is not None or not is_locked(lock):
            return pid or None
    return said_holder(lock) if said else None


def _listed(lock: Path) -> int | None:
    """Return the pid in the kernel's list, 0 if of another namespace, None if there is none."""
    try:
        stat = lock.stat()
        lines = Path("/proc/locks").read_text().splitlines()
    except OSError:
        return None
    wanted = f"{os.major(stat.st_dev):02x}:{os.minor(stat.st_dev):02x}:{stat.st_ino}"
    for line in lines:
        fields = line.split()
        # A READ lock belongs to a process that only checks whether the file is locked.
        if len(fields) >= 6 and fields[1:4:2] == ["FLOCK", "WRITE"] and fields[5] == wanted:
            return max(0, int(fields[4]))
    return None


def said_holder(lock: Path) -> int | None:
    """Return the pid in a lock file, written by its last holder, or None."""
    with contextlib.suppress(OSError, ValueError):
        return max(0, int(lock.read_text())) or None
    return None


def unwritable(folder: Path) -> str:
    """Return why a folder's disk cannot be written, `full` or `read-only`; empty if it can."""
    try:
        seen = os.statvfs(folder)
    except OSError:
        return ""  # it has just been removed
    if seen.f_flag & os.ST_RDONLY:
        return "read-only"
    no_room = seen.f_bavail * seen.f_frsize < _ROOM_BYTES or (seen.f_files and not seen.f_favail)
    return "full" if no_room else ""


def version(path: Path) -> tuple[int, int, int] | None:
    """Return a value that changes when a file is replaced or written; None if there is no file."""
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_ino, stat.st_size


class Watched:
    """Watches a file for changes; with `from_now`, a file that exists already is not a change."""

    def __init__(self, path: Path, *, from_now: bool = False) -> None:
        self.path = path
        self._seen = version(path) if from_now else None

    def changed(self) -> bool:
        """Return whether the file exists and differs from the one seen at the last call."""
        found, before = version(self.path), self._seen
        self._seen = found or before
        return found not in (None, before)

    def forget(self) -> None:
        """Report the file as changed at the next call: what it held could not be used."""
        self._seen = None
