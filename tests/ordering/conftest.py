"""What the simulations of ordered services may use."""

from __future__ import annotations

import pytest

from fogft.ordering import catching_up, peer


@pytest.fixture(params=["wide", "narrow"])
def limits(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """With narrow limits replicas fall too far behind all the time."""
    if request.param == "narrow":
        monkeypatch.setattr(peer, "LAG_LIMIT", 3)
        monkeypatch.setattr(catching_up, "WINDOW", 2)
