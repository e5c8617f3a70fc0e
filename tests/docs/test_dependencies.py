"""The page of dependencies names each dependency of pyproject.toml, and no other."""

from __future__ import annotations

import re

import pytest

from tests.docs.documents import ROOT, table_rows
from tests.needs import need


@pytest.fixture
def declared():
    """Return (who installs it, package) of each entry, read by a TOML parser."""
    need("tomllib", whole_file=False)
    import tomllib

    toml = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project = toml["project"]
    lists = {
        "building the wheel": toml["build-system"]["requires"],
        "`fogft`": project["dependencies"],
        **{f"`fogft[{name}]`": one for name, one in project["optional-dependencies"].items()},
    }
    return {
        (who, re.split(r"[><=~!;]", entry)[0].strip())
        for who, entries in lists.items()
        for entry in entries
    }


def test_the_page_and_pyproject_list_the_same_dependencies(declared):
    page = (ROOT / "docs" / "design" / "dependencies.md").read_text()
    _, *rows = [row for row in table_rows(page) if len(row) == 3 and "---" not in row[0]]
    assert {(who, package.strip("`")) for who, package, _ in rows} == declared
    assert [row for row in rows if len(row[2]) < 4] == []
