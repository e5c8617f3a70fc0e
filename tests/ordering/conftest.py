"""What the simulations of ordered services may use."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from fogft.ordering import catching_up, peer
from fogft.ordering.catching_up import OrderedLog


@pytest.fixture(params=["wide", "narrow"])
def limits(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """With narrow limits replicas fall too far behind all the time."""
    if request.param == "narrow":
        monkeypatch.setattr(peer, "LAG_LIMIT", 3)
        monkeypatch.setattr(catching_up, "WINDOW", 2)


@pytest.fixture(autouse=True, scope="module")
def usual_log() -> Iterator[None]:
    """Give the log its own length back, which each world sets."""
    usual = OrderedLog.entries_limit
    yield
    OrderedLog.entries_limit = usual
