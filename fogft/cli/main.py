"""The ``fogft`` command: runs a command and turns its outcome into an exit status.

Exit status: 0 success; 1 a `FogftError` or a file error, shown without a stack trace; 2 wrong
usage; 130 interrupted; 141 stdout was closed by its reader. Any other exception is a bug in fogft
and keeps its stack trace.

Slow imports are made inside the command that needs them (tests/cli/test_elsewhere).
"""

import io
import os
import sys
from collections.abc import Sequence
from errno import EDQUOT, ENOSPC
from typing import Annotated

import typer

from fogft import __version__
from fogft.cli import output
from fogft.cli.commands import Commands
from fogft.errors import FogftError

INTERRUPTED = 130
STDOUT_CLOSED = 141
# Typer's words in errors about values, and fogft's.
_OTHER_WORDS = (
    (" range.", "."),
    ("a valid integer", "a whole number"),
    ("a valid int", "a whole number"),
    ("a valid float", "a number"),
)

app = typer.Typer(
    name="fogft",
    cls=Commands,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Run ROS 2 services on cheap machines that come and go.

    \b
    fogft init          write an example pool
    fogft up            start the pool that a file describes
    fogft down          shut it down
    """
    if version:
        output.data(f"fogft {__version__}")
    elif context.invoked_subcommand is None:
        output.say(context.get_help())
        raise typer.Exit(2)


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line and exit the process."""
    while (free := os.open(os.devnull, os.O_RDWR)) < 3:  # keeps files off closed streams
        os.set_inheritable(free, True)
    nowhere = os.fdopen(free, "w", errors="replace")
    sys.stdout, sys.stderr = sys.stdout or nowhere, sys.stderr or nowhere
    if isinstance(sys.stdout, io.TextIOWrapper):  # not every locale can encode all characters
        sys.stdout.reconfigure(errors="replace")
    sys.exit(run(sys.argv[1:] if args is None else args))


def run(args: Sequence[str]) -> int:
    """Run the command line and return the exit status."""
    try:
        return _run(args)
    except KeyboardInterrupt:
        output.say("interrupted")
        return INTERRUPTED
    except BrokenPipeError:
        if not output.silenced_stdout():
            raise
        return STDOUT_CLOSED


def _run(args: Sequence[str]) -> int:
    command = typer.main.get_command(app)
    if os.environ.get("_FOGFT_COMPLETE"):
        command(prog_name="fogft")  # answers the shell and exits
    # Not `command(args)`, which exits silently on any broken pipe, even a socket's.
    # The base class of usage errors is in a private module of Typer.
    usage_error: type[Exception] = typer.BadParameter.__mro__[2]
    try:
        with command.make_context("fogft", list(args)) as context:
            command.invoke(context)
        sys.stdout.flush()
    except typer.Exit as exit_:
        sys.stdout.flush()
        return int(exit_.exit_code)
    except FogftError as problem:
        output.error(problem.message, problem.hint)
        return 1
    except usage_error as problem:
        _explain_usage(problem)
        return 2
    except OSError as problem:
        no_room = problem.errno in (ENOSPC, EDQUOT) or "usable temporary" in str(problem)
        if problem.filename is None and not no_room:
            raise  # a connection's, not a file's
        where = "an open file" if problem.filename is None else f"`{problem.filename}`"
        hint = "free some space, or set TMPDIR to a folder that has some"
        output.error(f"{where}: {problem.strerror}", hint if problem.filename is None else "")
        if problem.filename is None:
            output.discard(1)  # it may be this file
        return 1
    return 0


def _explain_usage(problem: Exception) -> None:
    message = getattr(problem, "format_message", problem.__str__)()
    context = getattr(problem, "ctx", None)
    path = context.command_path if context else "fogft"
    for theirs, ours in _OTHER_WORDS:
        message = message.replace(theirs, ours)
    metavar = getattr(getattr(problem, "param", None), "metavar", None)
    slot = "; the slot of replica `2.1` is 2" if metavar == "SLOT" else ""
    has_pool = context and any("--pool" in one.opts for one in context.command.params)
    is_extra = type(problem).__name__ == "UsageError"  # itself: too many arguments
    pool = "; name a pool with `--pool NAME`" if has_pool and is_extra else ""
    output.error(message[:1].lower() + message[1:].rstrip("."), f"see `{path} --help`{slot}{pool}")
