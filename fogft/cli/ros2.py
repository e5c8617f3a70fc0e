"""``ros2 fog``: the commands of ``fogft`` as verbs of ``ros2``. Loaded by ros2cli only."""

import argparse
from typing import Any

from ros2cli.command import CommandExtension, add_subparsers_on_demand
from ros2cli.plugin_system import PLUGIN_SYSTEM_VERSION, satisfies_version

VERBS = "fogft.ros2_verb"  # the group of entry points


class FogCommand(CommandExtension):  # type: ignore[misc]
    """Run ROS 2 services on cheap machines that come and go."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add a parser for each verb."""
        self._parser = parser
        add_subparsers_on_demand(parser, cli_name, "_verb", VERBS, required=False)

    def main(self, *, parser: argparse.ArgumentParser, args: Any) -> int:
        """Run the verb; without one, list the verbs."""
        del parser
        if not hasattr(args, "_verb"):
            self._parser.print_help()
            return 0
        status: int = args._verb.main(args=args)
        return status


class Verb:
    """A verb that runs the ``fogft`` command of the same name, with its help and options."""

    EXTENSION_POINT_VERSION = "0.1"

    def __init__(self) -> None:
        satisfies_version(PLUGIN_SYSTEM_VERSION, "^0.1")

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Pass every argument on unchanged, ``--help`` included."""
        del cli_name
        parser.add_argument("words", nargs=argparse.REMAINDER)
        parser.prefix_chars = "\0"  # no word is an option of this parser

    def main(self, *, args: Any) -> int:
        """Run the command; return its exit status."""
        from fogft.cli import main

        return main.run([type(self).__name__.lower(), *args.words])


def __getattr__(name: str) -> type[Verb]:
    """Make the verb that an entry point names; ``Up`` is ``fogft up``, with its help."""
    from fogft.cli.commands import Commands

    described = Commands().commands[name.lower()].help
    return type(name, (Verb,), {"__doc__": described})
