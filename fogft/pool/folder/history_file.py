"""The history of a pool in a file: events are on disk before anything acts on them.

A launch is written before the cloud is asked, so that its generation is never used twice. Other
events that cannot be written count all the same, and are written once there is room.

Owns: `history.jsonl`. Not here: what follows from events (`fogft.planning.observed.history`).
"""

import contextlib
import json
import os
import threading
from collections.abc import Callable
from pathlib import Path

from fogft import disk
from fogft.errors import StateError
from fogft.model.plain import from_plain, to_plain
from fogft.planning.observed.history import Event, EventKind, History, compacted

COMPACT_AFTER = 20_000


class HistoryFile:
    """The events of one pool. Safe to use from several threads; one process writes it.

    `heard` is called with each event, once it counts. Reading changes nothing on disk.
    """

    def __init__(self, path: Path, clock: Callable[[], float]) -> None:
        self._path = path
        self._clock = clock
        self._lock = threading.RLock()
        self._known: History | None = None
        self._appended = 0
        self._unwritten = b""
        self._is_long = False  # the file needs compaction, by its writer only
        self.heard: Callable[[Event], object] = lambda _: None

    def history(self) -> History:
        """Return the history so far."""
        with self._lock:
            if self._known is None:
                self._known = self._load()
            return self._known

    def append(self, event: Event) -> None:
        """Append an event; a launch is on disk when this returns, or it raises `StateError`."""
        history = self.history()
        with self._lock:
            if self._is_long:
                self._is_long = False
                kept = compacted(_read_events(self._path), self._clock())
                with contextlib.suppress(StateError):  # no space: it is not compacted
                    disk.write_whole(self._path, "".join(map(_line, kept)))
            before, self._unwritten = self._unwritten, self._unwritten + _line(event).encode()
            error = self.flush()
            if error is not None and event.kind is EventKind.LAUNCH:
                self._unwritten = before
                raise disk.not_done("written", self._path, error) from error
            history.add(event)
            self._appended += 1
            if self._appended >= COMPACT_AFTER and not self._unwritten:
                self._known = self._load()
        self.heard(event)

    def flush(self) -> OSError | None:
        """Write the events that a full disk did not take; return what still prevents it."""
        with self._lock:
            try:
                if self._unwritten:
                    _append_durably(self._path, self._unwritten)
                    self._unwritten = b""
            except OSError as error:  # no reason to keep paying
                return error
        return None

    def recent(self, count: int = 20) -> list[Event]:
        """Return the last events, oldest first."""
        return _read_events(self._path)[-count:]

    def _load(self) -> History:
        events = _read_events(self._path)
        kept = compacted(events, self._clock())
        self._appended, self._is_long = 0, len(kept) < len(events)
        return History(kept)


def _line(event: Event) -> str:
    return json.dumps(to_plain(event)) + "\n"


def _append_durably(path: Path, line: bytes) -> None:
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
    try:
        size = os.fstat(descriptor).st_size
        if size and os.pread(descriptor, 1, size - 1) != b"\n":
            line = b"\n" + line  # a crash left a torn last line: it keeps a line of its own
        try:
            if os.write(descriptor, line) != len(line):
                raise OSError(28, "No space left on device")
            os.fsync(descriptor)
        except OSError:
            os.ftruncate(descriptor, size)
            raise
    finally:
        os.close(descriptor)


def _read_events(path: Path) -> list[Event]:
    """Return the events of a file; a torn last line and other damaged lines are skipped."""
    events = []
    for line in (disk.read_bytes(path) or b"").splitlines():
        with contextlib.suppress(ValueError, RecursionError):
            events.append(from_plain(Event, json.loads(line)))
    return events
