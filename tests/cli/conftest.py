"""A state folder of its own for each test, and terminals of a fixed width."""

from __future__ import annotations

from pathlib import Path

import pytest

from fogft.pool.manager import distances


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty state folder, which every command uses."""
    folder = tmp_path / "fogft"
    folder.mkdir(mode=0o700)
    monkeypatch.setenv("FOGFT_HOME", str(folder))
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setattr(distances, "connect_time", _unreachable)  # no test asks the Internet
    for name in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE"):
        monkeypatch.delenv(name, raising=False)
    return folder


def _unreachable(host: str, port: int) -> float:
    raise OSError(f"{host} is not asked by tests")
