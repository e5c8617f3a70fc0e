"""Where text goes and how it looks: data to stdout, messages to stderr, both fine without colour.

What a command answers (a table, JSON, a log) is data. Progress, hints and errors are
messages. A script may therefore read stdout and ignore stderr.

Owns: streams, colour, width, the shape of an error.
Not here: what is said (the commands).
"""

from __future__ import annotations

import json
import os
import select
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import IO, Any

from fogft.errors import FogftError

# A table that is read by another program is never cut.
_WIDTH_OF_A_PIPE = 240

_RED, _YELLOW, _CYAN, _GREEN, _RESET = (
    "\033[1;31m",
    "\033[1;33m",
    "\033[1;36m",
    "\033[1;32m",
    "\033[0m",
)


def data(text: str) -> None:
    """Write a line (or lines) of data to stdout, at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def json_data(value: Any) -> None:
    """Write a value as JSON to stdout."""
    data(json.dumps(value, indent=2, default=str))


def say(text: str) -> None:
    """Write a message to stderr, at once."""
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


def done(text: str) -> None:
    """Write a message of success: ``done: text``."""
    say(f"{_painted('done:', _GREEN)} {text}")


def warn(text: str) -> None:
    """Write a warning: ``warning: text``."""
    say(f"{_painted('warning:', _YELLOW)} {text}")


def hint(text: str) -> None:
    """Write what to do next, after a blank line: ``hint: text``."""
    say(f"\n{_painted('hint:', _CYAN)} {text}")


def error(message: str, hint_text: str = "") -> None:
    """Write what went wrong and, after a blank line, what to do about it."""
    say(f"{_painted('error:', _RED)} {message}")
    if hint_text:
        hint(hint_text)


def failure(problem: FogftError) -> None:
    """Write a `FogftError`, without a stack trace."""
    error(problem.message, problem.hint)


def confirm(question: str) -> bool:
    """Ask a yes-or-no question on the terminal; anything but yes is no.

    Raises:
        FogftError: There is nobody to ask.
    """
    if not is_terminal(sys.stdin):
        raise FogftError("nobody is there to say yes", "add `--yes` to go on without being asked")
    sys.stderr.write(f"{question} [y/N] ")
    sys.stderr.flush()
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def coloured(stream: IO[str]) -> bool:
    """Whether a stream wants colour: a terminal that is not dumb, and no ``NO_COLOR``."""
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb"
    return not plain and is_terminal(stream)


def is_terminal(stream: IO[str]) -> bool:
    """Whether a person looks at this stream."""
    try:
        return stream.isatty()
    except ValueError:  # closed
        return False


def width(stream: IO[str]) -> int:
    """Return how many characters fit in a line of a stream."""
    if not is_terminal(stream) and not os.environ.get("COLUMNS"):
        return _WIDTH_OF_A_PIPE
    return shutil.get_terminal_size().columns


@contextmanager
def redrawn(stream: IO[str]) -> Iterator[Callable[[Sequence[str]], None]]:
    """Yield a function that shows lines on a terminal in place of those that it showed before."""
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    console = Console(file=stream, color_system="auto" if coloured(stream) else None)
    with Live(console=console, auto_refresh=False, vertical_overflow="crop") as live:
        yield lambda lines: live.update(
            Text.from_ansi("\n".join(lines), no_wrap=True, overflow="ellipsis"), refresh=True
        )


def aligned(rows: Iterable[Iterable[str]], gap: int = 2) -> str:
    """Lay rows out in columns of plain text; the last column is left as it is."""
    cells = [list(row) for row in rows]
    widths = [max(map(len, column)) for column in zip(*(r[:-1] for r in cells), strict=True)]
    return "\n".join(
        "".join(cell.ljust(width + gap) for cell, width in zip(row, widths, strict=False)) + row[-1]
        for row in cells
    )


def stdout_closed() -> bool:
    """Whether nobody reads stdout any more, as after ``| head``."""
    try:
        poll = select.poll()
        poll.register(sys.stdout.fileno(), 0)
        return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))
    except (OSError, ValueError):
        return True


def silence_stdout() -> None:
    """Send what is still buffered for a closed stdout nowhere, so that exit stays quiet."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)


def _painted(text: str, code: str, wants: Callable[[IO[str]], bool] = coloured) -> str:
    return f"{code}{text}{_RESET}" if wants(sys.stderr) else text
