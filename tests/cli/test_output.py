"""What reaches a terminal: no control character from elsewhere, and colour only where wanted."""

from __future__ import annotations

import io

import pytest

from fogft.cli import output
from fogft.cli.table import table

HOSTILE = "a\x1b[2Jb\rc\x07\u202e"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_control_characters_are_escaped_and_lines_kept():
    assert output.printable(HOSTILE) == r"a\x1b[2Jb\rc\x07\u202e"
    assert output.printable("plain ü\nand more") == "plain ü\nand more"


def test_no_table_tree_or_message_passes_control_characters_on(capsys):
    output.show(table(["NAME"], [[HOSTILE], ["one\ntwo"]]), output.cell(HOSTILE))
    output.warn(HOSTILE)
    said = capsys.readouterr()
    for text in (said.out, said.err):
        assert all(c.isprintable() or c == "\n" for c in text)
    assert said.out.splitlines()[2] == r"one\ntwo"


def test_data_and_a_log_pass_no_control_characters_on(capsys):
    """Colours of a log go, tabs stay, and everything else is shown as what it is."""
    output.data(f"\x1b[1;31mred\x1b[0m\t{HOSTILE}\x1b]0;title\x07")
    said = capsys.readouterr().out
    assert said == "red\t" + r"a\x1b[2Jb\rc\x07\u202e\x1b]0;title\x07" + "\n"


def test_square_brackets_are_text_and_not_markup(capsys):
    output.show(table(["NAME"], [["[bold]x[/bold] :smile:"]]))
    assert capsys.readouterr().out.splitlines()[1] == "[bold]x[/bold] :smile:"


@pytest.mark.parametrize(
    ("environ", "coloured"), [({}, True), ({"NO_COLOR": "1"}, False), ({"TERM": "dumb"}, False)]
)
def test_messages_have_colour_on_a_terminal_only(monkeypatch, environ, coloured):
    stream = Terminal()
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    for name, value in environ.items():
        monkeypatch.setenv(name, value)
    output.error("it broke " + "x" * 200, "mend it")
    lines = stream.getvalue().splitlines()
    assert ("\033[" in lines[0]) is coloured
    assert lines[0].endswith(" it broke " + "x" * 200), "nothing is broken into lines"
    assert len(lines) == 3
