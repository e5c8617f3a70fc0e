"""What the documents say is so: links lead somewhere, names exist, nothing private is told."""

from __future__ import annotations

import re
import shlex

import pytest

from fogft.model.reason import Cause
from tests.docs.documents import ROOT, anchors, documents, links, table_rows

DOCUMENTS = documents()
IDS = [str(d.relative_to(ROOT)) for d in DOCUMENTS]

# Paths of a developer's machine, and hosts that packages come from: neither is anyone's business.
FORBIDDEN = re.compile(
    r"/work/|/tmp/|/root/|/home/\w+|https?://\S*(?:simple|registry)|TODO|FIXME|XXX|issue #?\d", re.I
)


@pytest.mark.parametrize("document", DOCUMENTS, ids=IDS)
def test_links_lead_somewhere(document):
    broken = []
    for link in links(document.read_text()):
        if re.match(r"https?://", link):
            continue
        path, _, anchor = link.partition("#")
        target = (document.parent / path).resolve() if path else document
        if not target.exists() or (anchor and anchor not in anchors(target.read_text())):
            broken.append(link)
    assert broken == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=IDS)
def test_nothing_of_a_developers_machine_is_told(document):
    assert [m[0] for m in FORBIDDEN.finditer(document.read_text())] == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=IDS)
def test_files_that_are_named_exist(document):
    """A path in backquotes under a folder of ours is there."""
    folders = "scripts|tests|docs|fogft|templates|\\.ci"
    named = re.findall(rf"`((?:{folders})/[\w./*-]+)`", document.read_text())
    assert [n for n in named if not list(ROOT.glob(n.rstrip("/")))] == []


def test_every_design_page_is_in_the_index():
    folder = ROOT / "docs" / "design"
    listed = {link for link in links((folder / "index.md").read_text()) if "/" not in link}
    assert listed == {page.name for page in folder.glob("*.md")} - {"index.md"}


def test_the_glossary_is_in_alphabetical_order_and_short():
    page = (ROOT / "docs" / "reference" / "glossary.md").read_text()
    words = [re.findall(r"\*\*(.+?)\*\*", row[0]) for row in table_rows(page)]
    first = [found[0].lower() for found in words if found]
    assert 20 < len(first) < 40
    assert first == sorted(first)


def test_the_messages_of_the_troubleshooting_page_are_the_programs_own():
    """Each piece between `...` stands so in the code, wherever a string is broken or filled in."""
    sources = [*(ROOT / "fogft").rglob("*.py"), ROOT / "scripts" / "setup"]
    code = "\n".join(path.read_text() for path in sources)
    code = re.sub(r'"\s*\n\s*f?"', "", code)
    page = (ROOT / "docs" / "how-to" / "troubleshooting.md").read_text()
    told = [
        message.strip()
        for row in table_rows(page)
        for message in re.findall(r"(?<!`)(`+)(.+?)\1(?!`)", row[0])
        for message in re.split(r"\.\.\.", message[1])
    ]
    assert len(told) > 25
    assert [message for message in told if message not in code] == []


def test_every_cause_is_listed():
    page = (ROOT / "docs" / "reference" / "diagnostics.md").read_text()
    assert [cause.value for cause in Cause if f"`{cause.value}`" not in page] == []


@pytest.mark.parametrize(
    "script", ["setup", "test", "check", "docs", "bench", "quickstart", "fuzz", "reproduce"]
)
def test_scripts_are_sound(script):
    """Each can be run, stops at the first error, and says what it is for."""
    path = ROOT / "scripts" / script
    lines = path.read_text().splitlines()
    assert path.stat().st_mode & 0o111
    assert lines[0] == "#!/usr/bin/env bash"
    assert lines[1].startswith("# ")
    assert "set -euo pipefail" in lines
    assert shlex.split(lines[0][2:])
