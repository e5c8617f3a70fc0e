"""Log files: all output of a process and its children, in one file of bounded size."""

import os
from pathlib import Path

LIMIT_BYTES = 64 << 20
KEPT_BYTES = 4 << 20
TAIL_LINES = 5
_TAIL_BYTES = 4096


def size(path: Path) -> int:
    """Return the size of a log in bytes; 0 if there is none."""
    return path.stat().st_size if path.exists() else 0


def tail(path: Path, begin: int = 0, lines: int = TAIL_LINES) -> str:
    """Return the last lines of a log, from offset `begin` on; empty without a log."""
    try:
        with path.open("rb") as file:
            file.seek(max(begin, size(path) - _TAIL_BYTES))
            found = file.read().decode(errors="replace").splitlines()
    except OSError:
        return ""
    return "\n".join(found[-lines:])


def bound(path: Path, limit_bytes: int = LIMIT_BYTES, kept_bytes: int = KEPT_BYTES) -> None:
    """Truncate a log that has grown too long, keeping its end. Appending writers are unaffected."""
    if size(path) <= limit_bytes:
        return
    with path.open("r+b") as file:
        file.seek(-kept_bytes, os.SEEK_END)
        kept = file.read()
        file.truncate(0)
        file.seek(0)
        file.write(b"log_shortened\n" + kept.partition(b"\n")[2])
