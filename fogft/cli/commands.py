"""The list of commands, grouped by task, and the layout of their help.

A command's module is imported when the command is run or described.
"""

import keyword
import math
import sys
from collections import UserDict
from collections.abc import Iterable, Mapping
from functools import cache
from importlib import import_module
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from fogft.errors import FogftError

# Section -> command -> its module in this package, and the arguments of an example.
SECTIONS: Mapping[str, Mapping[str, tuple[str, str]]] = {
    "Start and stop": {
        "init": ("lifecycle", "planner --into my_pool"),
        "bake": ("plan", "pool.yaml --tag registry.example.com/planner:1"),
        "up": ("lifecycle", "pool.yaml"),
        "join": ("credentials", "ada.join"),
        "down": ("lifecycle", ""),
        "sweep": ("sweep", ""),
    },
    "Inspect": {
        "check": ("plan", "pool.yaml"),
        "plan": ("plan", "pool.yaml"),
        "list": ("overview", ""),
        "status": ("status", "--watch"),
        "top": ("screens.top", ""),
        "events": ("overview", "-n 20"),
        "cost": ("overview", ""),
        "report": ("screens.report", "planner --into planner.html"),
        "logs": ("status", "2 -f"),
        "doctor": ("doctor", "pool.yaml"),
    },
    "Change a running pool": {
        "scale": ("change", ""),
        "drain": ("change", "2"),
        "exclude": ("change", "local/us-west-2"),
        "include": ("change", "local/us-west-2"),
        "retry": ("change", ""),
        "credentials": ("credentials", ""),
        "export": ("credentials", "planner planner.pool"),
        "import": ("credentials", "planner.pool"),
        "service": ("parts", ""),
    },
    "Simulate and inject faults": {
        "simulate": ("simulate", "pool.yaml --traces recorded/ --plot report.png"),
        "chaos": ("chaos", ""),
    },
    "Run one part in the foreground": {
        "proxy": ("parts", "--config ~/.local/state/fogft/pools/planner/proxy.yaml"),
        "serve": ("parts", "--config replica.yaml --listen 0.0.0.0:7448"),
        "manager": ("parts", "planner"),
        "rendezvous": ("parts", "--config rendezvous.yaml --listen 0.0.0.0:7450"),
        "gateway": ("parts", "--config gateway.yaml --listen 0.0.0.0:7470"),
    },
}
ANYWHERE = frozenset({"check", "init", "plan", "simulate"})  # the others need Linux
_WHOLE = 1000  # characters of a description: it wraps and is not cut
_COMMANDS = {name: row for names in SECTIONS.values() for name, row in names.items()}


class _Loaded(UserDict[str, Any]):
    def __getitem__(self, name: str) -> Any:
        return _load(name, *self.data[name])


@cache
def _load(name: str, module: str, example: str) -> Any:
    if sys.platform != "linux" and name not in ANYWHERE:
        return _elsewhere(name)
    found = getattr(import_module(f"fogft.cli.{module}"), name + "_" * keyword.iskeyword(name))
    if isinstance(found, typer.Typer):
        return typer.main.get_command(found)
    alone = typer.Typer(rich_markup_mode=None, add_completion=False)
    alone.command(name, cls=Command, epilog=f"fogft {name} {example}")(found)
    return typer.main.get_command(alone)


def _elsewhere(name: str) -> Any:
    def refuse() -> None:
        raise FogftError(
            f"`fogft {name}` needs Linux; this is {sys.platform}",
            f"available here: {', '.join(f'`fogft {one}`' for one in sorted(ANYWHERE))}; "
            "every command works in WSL, in a container or on a Linux machine",
        )

    alone = typer.Typer(add_completion=False)
    anything = {"ignore_unknown_options": True, "allow_extra_args": True, "help_option_names": []}
    alone.command(name, help="Needs Linux.", context_settings=anything)(refuse)
    return typer.main.get_command(alone)


class Group(TyperGroup):
    """A group of commands whose descriptions wrap and are never cut."""

    sections: Mapping[str, Iterable[str]] = {}  # without any, all commands are in one list

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write one list for each section."""
        for title, names in (self.sections or {"Commands": self.commands}).items():
            with formatter.section(title):
                formatter.write_dl(
                    [(n, self.commands[n].get_short_help_str(_WHOLE)) for n in names]
                )


def group(help: str) -> typer.Typer:
    """Return a group of commands, to which a module adds its own."""
    return typer.Typer(cls=Group, rich_markup_mode=None, add_completion=False, help=help)


class Commands(Group):
    """The root of all commands, listed by section."""

    sections = SECTIONS

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.commands: Any = _Loaded(_COMMANDS)


class Command(TyperCommand):
    """A command whose help shows arguments as ``SLOT`` or ``[FILE]``, without types and ranges."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse as usual, but refuse "nan", which passes every range check."""
        rest: list[str] = super().parse_args(ctx, args)
        for one in self.get_params(ctx):
            if isinstance(value := ctx.params.get(one.name), float) and math.isnan(value):
                raise typer.BadParameter("`nan` is not a number", ctx, one)
        return rest

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the parts of the usage line that follow the command's name."""
        return ["[OPTIONS]", *map(_word, self._arguments(ctx))]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, then the options."""
        arguments = [(_word(one), _meaning(one)) for one in self._arguments(ctx)]
        options = [one for one in self.get_params(ctx) if one.param_type_name == "option"]
        records = [record for one in options if (record := one.get_help_record(ctx))]
        for title, rows in (("Arguments", arguments), ("Options", records)):
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the example."""
        with formatter.section("Example"):
            formatter.write_text(self.epilog or "")

    def _arguments(self, ctx: Any) -> list[Any]:
        return [one for one in self.get_params(ctx) if one.param_type_name == "argument"]


def _word(argument: Any) -> str:
    name = (argument.metavar or argument.name or "").upper()
    return name if argument.required else f"[{name}]"


def _meaning(argument: Any) -> str:
    default = argument.default if argument.show_default else None
    text: str = argument.help or ""
    return text + (f"  [default: {default}]" if default not in (None, "") else "")
