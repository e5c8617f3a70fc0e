"""Answers that are kept for a while."""

from __future__ import annotations

from fogft.cloud.sky.kept import Kept


def test_what_was_asked_before_it_was_to_be_forgotten_is_asked_again():
    """SkyPilot's list is long under way: a replica that ended meanwhile would be listed again."""
    machines = ["0.1"]

    def ask() -> list[str]:
        listed = list(machines)
        if machines:
            machines.clear()
            kept.forget()
        return listed

    kept = Kept(ask, 5.0, 15.0, lambda: 1000.0, lambda run: run(), failed=lambda _: None)
    assert kept.get() == ["0.1"]
    assert kept.get() == []
