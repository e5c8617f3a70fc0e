"""Each cloud that is under the contract, one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.contract.clouds import MAKERS, CloudUnderTest


@pytest.fixture(params=sorted(MAKERS))
def made(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[CloudUnderTest]:
    """A cloud with nothing in it."""
    yield from MAKERS[request.param](tmp_path)
