"""How help looks: commands by what people want to do, arguments by their names alone."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand, TyperGroup

SECTIONS = {
    "Begin and end": ("init", "up", "join", "down", "sweep"),
    "Look": ("plan", "status", "logs", "doctor"),
    "Change what runs": ("scale", "drain", "exclude", "include", "credentials"),
    "Try what happens when": ("simulate", "chaos"),
    "Run one part by hand": ("proxy", "serve", "manager", "rendezvous", "gateway"),
}


class Commands(TyperGroup):
    """A group that lists its commands by section; `tests/cli` checks that none is left out."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write one list a section."""
        for title, names in SECTIONS.items():
            found = [(name, self.get_command(ctx, name)) for name in names]
            with formatter.section(title):
                formatter.write_dl(
                    [(n, c.get_short_help_str(formatter.width)) for n, c in found if c is not None]
                )


class Command(TyperCommand):
    """A command whose arguments stand as ``SLOT`` or ``[FILE]``, without types and ranges."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return what stands behind the command's name in its usage line."""
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

    def _arguments(self, ctx: Any) -> list[Any]:
        return [one for one in self.get_params(ctx) if one.param_type_name == "argument"]


def _word(argument: Any) -> str:
    name = (argument.metavar or argument.name or "").upper()
    return name if argument.required else f"[{name}]"


def _meaning(argument: Any) -> str:
    default = argument.default if argument.show_default else None
    text: str = argument.help or ""
    return text + (f"  [default: {default}]" if default not in (None, "") else "")
