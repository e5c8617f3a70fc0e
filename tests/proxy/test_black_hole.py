"""A rendezvous in a black hole: no request fails, and what joined is known once it is back."""

from __future__ import annotations

import pytest

from tests.needs import needs
from tests.proxy import black_hole

pytestmark = pytest.mark.timeout(240)
ROUTER = pytest.param("router", marks=needs("namespaces", "night"))


@pytest.mark.parametrize("way", ["relay", ROUTER])
def test_no_request_fails_while_the_rendezvous_is_in_a_black_hole(tmp_path, way, record_property):
    """As short as it takes to be noticed; `python -m tests.proxy.black_hole` lasts for minutes.

    When it was known is recorded, not judged: this machine may be busy.
    """
    seen = black_hole.run(tmp_path / "pool", way, seconds=0.0)
    record_property("known_after_s", seen["known_after_s"])
    assert seen["asked_in_the_dark"] > 0
    assert seen["answered_rightly"] == seen["asked"] > seen["asked_in_the_dark"]
