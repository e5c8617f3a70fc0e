"""The dependencies' page and pyproject.toml list the same things."""

from __future__ import annotations

import re

from tests.docs.documents import ROOT, table_rows

try:
    import tomllib
except ImportError:  # Python 3.10
    import tomli as tomllib  # type: ignore[no-redef]

PAGE = (ROOT / "docs" / "design" / "dependencies.md").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def name(requirement: str) -> str:
    return re.match(r"[\w-]+", requirement)[0]


def page_sections() -> dict[str, set[str]]:
    """Return the names listed under each heading, by the extras that it speaks of."""
    sections = {}
    for part in re.split(r"^## ", PAGE, flags=re.MULTILINE)[1:]:
        heading, _, body = part.partition("\n")
        extras = ",".join(re.findall(r"fogft\[([\w-]+)\]", heading)) or heading
        sections[extras] = {
            listed
            for row in table_rows(body)
            if row[0][0] == "`"
            for listed in re.findall(r"`([\w-]+)`", row[0])
        }
    return sections


def test_page_and_project_agree():
    """Nothing is depended on without a reason, and no reason outlives its dependency."""
    extras = PROJECT["project"]["optional-dependencies"]
    expected = {
        "Always": {name(r) for r in PROJECT["project"]["dependencies"]},
        "To build": {name(r) for r in PROJECT["build-system"]["requires"]},
    }
    expected |= {extra: {name(r) for r in wanted} for extra, wanted in extras.items()}
    for together in (("ros", "ros-kilted"), ("test", "ros-test", "ros-kilted-test")):
        expected[",".join(together)] = set().union(*(expected.pop(extra) for extra in together))
    assert page_sections() == expected


def test_every_dependency_has_a_reason():
    rows = [row for row in table_rows(PAGE) if row[0][0] == "`"]
    assert [row[0] for row in rows if len(row[1]) < 5] == []
