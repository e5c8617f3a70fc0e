"""Each dependency in pyproject.toml says why it is there."""

from __future__ import annotations

import re

from tests.docs.documents import ROOT

LINES = (ROOT / "pyproject.toml").read_text().splitlines()


def test_every_dependency_has_a_reason():
    listed = [line for line in LINES if re.match(r'    "[\w-]+(\[\w+\])?[><=~!].*"?,', line)]
    assert len(listed) > 40
    assert [line for line in listed if not re.search(r'",  # \w.{3,}', line)] == []
