"""``python -m tests.docs.count``: how many words there are to read, and how many of design."""

from __future__ import annotations

import re
from pathlib import Path

from tests.docs.documents import ROOT, documents
from tests.docs.reference import BEGIN, END

NOT_COUNTED = (
    "CHANGELOG.md",
    "docs/changelog.md",
    "docs/measurements.md",
    "docs/simulation/README.md",
)


def words(page: Path) -> int:
    """Return a page's words without what is generated and what is no text."""
    text = re.sub(f"{re.escape(BEGIN)}.*?{re.escape(END)}", "", page.read_text(), flags=re.DOTALL)
    return len(text.split())


def design() -> dict[str, int]:
    """Return the words of each design page."""
    return {page.name: words(page) for page in documents() if page.parent.name == "design"}


def others() -> dict[str, int]:
    """Return the words of every other page; reports that a program wrote do not count."""
    pages = [page for page in documents() if page.parent.name != "design"]
    named = {str(page.relative_to(ROOT)): words(page) for page in pages}
    return {name: count for name, count in named.items() if name not in NOT_COUNTED}


if __name__ == "__main__":
    for name, count in sorted({**others(), **design()}.items()):
        print(f"{count:6} {name}")
    total, of_design = sum(others().values()), sum(design().values())
    print(f"{total:6} words to read, {of_design} in {len(design())} pages of design")
