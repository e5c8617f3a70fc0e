"""Fixtures for pools in a temporary home."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.pool.scene import Scene


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    """A pool's home; every process started there ends with the test."""
    scene = Scene(tmp_path)
    yield scene
    scene.close()
