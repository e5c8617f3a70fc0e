"""Every command explains itself with an example."""

from __future__ import annotations

import shlex
from typing import Any

import pytest
import typer

from fogft.cli import main
from fogft.cli.commands import SECTIONS


def commands() -> dict[str, Any]:
    """Return every command by its words, as ``fogft scale up``."""
    found = {}

    def walk(words: str, command: Any) -> None:
        for name, child in getattr(command, "commands", {}).items():
            if hasattr(child, "commands"):
                walk(f"{words} {name}", child)
            else:
                found[f"{words} {name}"] = child

    walk("fogft", typer.main.get_command(main.app))
    return found


@pytest.mark.parametrize("words", commands())
def test_every_command_has_help_with_an_example(words, capsys):
    assert main.run([*words.split()[1:], "--help"]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert said.out.startswith(f"Usage: {words} ")
    assert "Example:\n" in said.out
    assert max(map(len, said.out.splitlines())) <= 80
    example = said.out.split("Example:\n")[1].splitlines()[0].strip()
    assert example.startswith(words), "the example shows this very command"
    parses(example)


def test_the_list_of_commands_is_complete():
    """A command that stands in no section would be invisible."""
    listed = [name for names in SECTIONS.values() for name in names]
    assert sorted(listed) == sorted({words.split()[1] for words in commands()})


def test_the_list_fits_on_one_screen(capsys):
    main.run(["--help"])
    assert len(capsys.readouterr().out.splitlines()) <= 56


@pytest.mark.parametrize("words", ["", "chaos", "credentials", "scale", "service"])
def test_no_description_is_cut(words, capsys):
    main.run([*words.split(), "--help"])
    lines = capsys.readouterr().out.splitlines()
    assert not [line for line in lines if "..." in line and "ARGS" not in line]


def parses(example: str) -> None:
    """Fail unless a command line parses; it is not run."""
    words = shlex.split(example)
    assert words[0] == "fogft"
    command, rest = typer.main.get_command(main.app), words[1:]
    context = command.make_context("fogft", list(rest), resilient_parsing=False)
    while rest and rest[0] in getattr(command, "commands", {}):
        command = command.commands[rest[0]]
        context = command.make_context(rest[0], rest[1:], parent=context)
        rest = rest[1:]
    assert not hasattr(command, "commands"), f"`{example}` names no command"
