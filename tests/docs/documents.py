"""The project's documents, and what stands in them: commands, links, tables."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def documents() -> list[Path]:
    """Return every Markdown file that we ship."""
    return sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


def console_commands(text: str) -> list[str]:
    """Return the commands after ``$`` in the text's console blocks."""
    blocks = re.findall(r"^```console\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    return [line[2:] for block in blocks for line in block.splitlines() if line.startswith("$ ")]


def spoken_commands(text: str) -> list[str]:
    """Return what stands in backquotes and begins with `fogft` or a script of ours."""
    return re.findall(r"`((?:fogft(?: [^`\n]*)?|(?:scripts|\.ci)/[^`\n]*))`", text)


def links(text: str) -> list[str]:
    """Return the targets of the text's links, code left out."""
    without_code = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    return re.findall(r"\]\(([^)\s]+)\)", without_code)


def anchors(text: str) -> set[str]:
    """Return the anchors that the text's headings get."""
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


def table_rows(text: str) -> list[list[str]]:
    """Return the cells of every table row."""
    rows = re.findall(r"^\|(.+)\|$", text, re.MULTILINE)
    return [[cell.strip() for cell in row.split("|")] for row in rows]
