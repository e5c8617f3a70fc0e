"""Kinds of refusals: how they travel, and what follows from them."""

from __future__ import annotations

import pytest

from fogft.model.refusal import Effect, Refusal, read


@pytest.mark.parametrize("kind", list(Refusal))
@pytest.mark.parametrize("detail", ["", "17", "a:b"])
def test_a_refusal_travels_with_its_detail(kind, detail):
    assert read(kind.text(detail)) == (kind, detail)


def test_a_kind_of_a_later_version_is_a_refusal_all_the_same():
    """It counts towards the attempts, and its words are kept for the log."""
    assert read("on-strike:monday") == (Refusal.UNKNOWN, "on-strike:monday")
    assert Refusal.UNKNOWN.effect is Effect.NONE


def test_what_is_not_ascii_travels_as_ascii():
    assert Refusal.HELD.text("r\u00e9my") == "held:r?my"
