"""Every command in the documents exists and takes what it is given there."""

from __future__ import annotations

import itertools
import re
import shlex

import pytest
import typer

from fogft.cli.main import app
from tests.docs.documents import ROOT, console_commands, documents, spoken_commands, table_rows

COMMAND = typer.main.get_command(app)
CONSOLE = [
    pytest.param(command, id=f"{document.name}: {command}")
    for document in documents()
    for command in console_commands(document.read_text())
]
SPOKEN = sorted({c for document in documents() for c in spoken_commands(document.read_text())})


FOREIGN = {".", "aws", "git", "pip", "python", "python3", "ros2", "sky", "sudo", "uv"}


def parse(arguments: list[str]) -> None:
    """Parse a command line of `fogft` as far as it goes, without running it."""
    command, context = COMMAND, COMMAND.make_context("fogft", [], resilient_parsing=True)
    while hasattr(command, "get_command") and arguments:
        name, *arguments = arguments
        inner = command.get_command(context, name)
        assert inner is not None, f"there is no `{name}` in `{context.command_path}`"
        strict = not hasattr(inner, "get_command")
        context = inner.make_context(
            name, list(arguments) if strict else [], parent=context, resilient_parsing=not strict
        )
        command = inner
        if strict:
            return
    assert not arguments


def check_script(words: list[str]) -> None:
    script = ROOT / words[0]
    assert script.exists()
    assert script.stat().st_mode & 0o111
    source = script.read_text() + "".join(
        path.read_text()
        for path in (
            ROOT / "scripts/quickstart_demo.py",
            ROOT / "tests/bench/__main__.py",
            ROOT / "tests/fuzz/__main__.py",
        )
    )
    for option in words[1:]:
        if option.startswith("--") and words[0] != "scripts/test":
            assert option in source, f"{words[0]} knows no {option}"


@pytest.mark.parametrize("command", CONSOLE)
def test_a_command_to_type_can_be_typed(command):
    """Of a pipe, the command that it begins with."""
    words = list(itertools.takewhile("|".__ne__, shlex.split(command)))
    if words[0] == "fogft":
        parse([word for word in words[1:] if not word.endswith("-completion")])
    elif words[0].startswith(("scripts/", ".ci/")):
        check_script(words)
    else:
        assert words[0].rpartition("/")[2] in FOREIGN


@pytest.mark.parametrize("command", SPOKEN)
def test_a_command_in_passing_exists(command):
    """Placeholders in capitals stand for values; what comes before must be a command."""
    words = shlex.split(re.sub(r"[\[\]|]", " ", command))
    if words[0] != "fogft":
        if (ROOT / words[0]).is_file():
            check_script(words)
        else:
            assert list(ROOT.glob(words[0]))
        return
    level = COMMAND
    context = COMMAND.make_context("fogft", [], resilient_parsing=True)
    for word in words[1:]:
        if word.startswith("-") or not hasattr(level, "get_command"):
            return
        level = level.get_command(context, word)
        assert level is not None, f"`{command}`: there is no `{word}`"


def test_the_readme_lists_every_command():
    rows = table_rows((ROOT / "README.md").read_text())
    listed = {name for row in rows for name in re.findall(r"`fogft ([a-z]+)", row[0])}
    visible = {name for name, command in COMMAND.commands.items() if not command.hidden}
    assert listed == visible


def test_the_two_commands_are_in_the_first_screen():
    first_screen = "\n".join((ROOT / "README.md").read_text().splitlines()[:24])
    assert console_commands(first_screen) == ["scripts/quickstart", "scripts/test"]
