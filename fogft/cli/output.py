"""Print to the terminal: data to stdout, messages to stderr, both readable without colour.

Rich is loaded when the first table, tree or redrawn screen is shown.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import sys
from collections.abc import Callable, Iterator
from typing import IO, TYPE_CHECKING, Any

import typer

from fogft import poll
from fogft.errors import FogftError

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.text import Text

# Wide enough that nothing is ever cut: a terminal wraps long lines by itself.
_UNLIMITED = 100_000
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")  # colours that a log may contain


def data(text: str) -> None:
    """Write lines of data to stdout, flushed, with control characters escaped."""
    print(printable(text), flush=True)


def json_data(value: Any) -> None:
    """Write a value as JSON to stdout."""
    data(json.dumps(value, indent=2, default=str))


def show(*parts: RenderableType, stream: IO[str] | None = None, folds: bool = True) -> None:
    """Write tables, trees and lines below each other, to stdout by default.

    On a terminal, lines wrap between words if `folds`; elsewhere nothing is wrapped or cut.
    """
    stream = stream or sys.stdout
    drawn = _drawn(stream, *parts, limit=width(stream) if folds else None)
    print(drawn, file=stream, flush=True)


def cell(text: str, style: str = "") -> Text:
    """Return text for a table or tree, with its control characters escaped."""
    from rich.text import Text

    return Text(printable(text).replace("\n", "\\n"), style)


def printable(text: str) -> str:
    """Escape control characters except newlines and tabs, so that text cannot move the cursor."""
    if text.isprintable():
        return text
    plain = _COLOUR.sub("", text)
    return "".join(c if c.isprintable() or c in "\n\t" else ascii(c)[1:-1] for c in plain)


def say(text: str) -> None:
    """Write a message to stderr, flushed. If nobody reads it, the command goes on."""
    with _goes_on():
        print(printable(text), file=sys.stderr, flush=True)


def done(text: str) -> None:
    """Write a message of success: ``done: text``."""
    _tagged("done:", "bold green", text)


def warn(text: str) -> None:
    """Write a warning: ``warning: text``."""
    _tagged("warning:", "bold yellow", text)


def hint(text: str) -> None:
    """Write what to do next, after a blank line: ``hint: text``."""
    say("")
    _tagged("hint:", "bold cyan", text)


def error(message: str, hint_text: str = "") -> None:
    """Write what went wrong and, after a blank line, what to do about it."""
    _tagged("error:", "bold red", message)
    if hint_text:
        hint(hint_text)


def confirm(question: str) -> None:
    """Ask a yes-or-no question on the terminal; anything but yes ends the command."""
    if not is_terminal(sys.stdin):
        raise FogftError(
            "cannot ask for confirmation: there is no terminal",
            "add `--yes` to skip the confirmation",
        )
    print(f"{printable(question)} [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        say("aborted: nothing was changed")
        raise typer.Exit(1)


def is_terminal(stream: IO[str]) -> bool:
    """Whether this stream is a terminal."""
    try:
        return stream.isatty()
    except ValueError:  # closed
        return False


def width(stream: IO[str]) -> int | None:
    """Return the width of a stream in characters; None if it is not a terminal."""
    if not is_terminal(stream) and not os.environ.get("COLUMNS"):
        return None
    return _console(stream).width


def indented(text: str, by: int) -> str:
    """Return text for stdout, wrapped between words, with the same left margin on each line."""
    import textwrap

    room = (width(sys.stdout) or _UNLIMITED) - by
    folded = textwrap.wrap(text, max(room, 20), break_long_words=False, break_on_hyphens=False)
    return ("\n" + " " * by).join(folded)


@contextlib.contextmanager
def redrawn(stream: IO[str]) -> Iterator[Callable[[RenderableType], None]]:
    """Yield a function that redraws its output in place; long lines are cut."""
    from rich.live import Live
    from rich.text import Text

    def show(shown: RenderableType) -> None:
        drawn = _drawn(stream, shown, limit=width(stream))
        live.update(Text.from_ansi(drawn, no_wrap=True, overflow="ellipsis"), refresh=True)

    with Live(console=_console(stream), auto_refresh=False, vertical_overflow="crop") as live:
        yield show


def silenced_stdout() -> bool:
    """Discard buffered stdout if its reader is gone, as after ``| head``; return whether it is."""
    with contextlib.suppress(OSError, ValueError):
        if not poll.is_ready(sys.stdout.fileno(), event=0):  # no event but an error
            return False
    discard(1)
    return True


@contextlib.contextmanager
def _goes_on() -> Iterator[None]:
    try:
        yield
    except OSError:
        discard(2)


def discard(descriptor: int) -> None:
    """Discard what a stream still buffers, which Python would fail to flush at exit."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)


def _drawn(stream: IO[str], *parts: RenderableType, limit: int | None) -> str:
    # With a height: otherwise rich assumes small values for both on a dumb terminal.
    console = _console(stream, width=limit or _UNLIMITED, height=25)
    with console.capture() as captured:
        console.print(*parts, sep="\n")
    return "\n".join(line.rstrip() for line in captured.get().splitlines())


def _tagged(tag: str, style: str, text: str) -> None:
    if not is_terminal(sys.stderr):
        say(f"{tag} {text}")
        return
    from rich.text import Text

    told = Text.assemble((tag, style), " ", printable(text))  # not wrapped: users copy commands
    with _goes_on():
        show(told, stream=sys.stderr, folds=False)


def _console(stream: IO[str], **options: Any) -> Console:
    from rich.console import Console

    # Under NO_COLOR rich still sends bold and dim; without a colour system it sends nothing.
    system: Any = None if os.environ.get("NO_COLOR") else "auto"
    return Console(
        file=stream, color_system=system, markup=False, highlight=False, emoji=False, **options
    )
