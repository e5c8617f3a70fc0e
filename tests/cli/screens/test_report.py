"""``fogft top`` and ``fogft report``: what they show of a pool on disk."""

from __future__ import annotations

import re
import time
from collections import deque

from fogft.cli import main
from fogft.cli.screens.report import ready_spans
from fogft.cli.screens.top import sparkline
from fogft.planning.observed.history import Event, EventKind
from fogft.pool.commands import composition
from tests.docs.browser import browser
from tests.fakes.pools import alive, lay_down
from tests.needs import needs

EVENTS = [
    Event(100.0, EventKind.LAUNCH, 0, 1, location="local/<west>/a"),
    Event(110.0, EventKind.READY, 0, 1),
    Event(150.0, EventKind.UNREADY, 0, 1),
    Event(160.0, EventKind.READY, 0, 1),
    Event(190.0, EventKind.GONE, 0, 1),
    Event(170.0, EventKind.READY, 1, 1),
]


def test_a_screen_has_trends_events_and_cost(home, capsys):
    """Without a terminal it is printed once."""
    with alive(lay_down(home)):
        for event in EVENTS:
            composition.make_store("planner").append(event)
        assert main.run(["top"]) == 0
    shown = capsys.readouterr().out
    assert "1 of 3 ready" in shown
    assert re.search(r"P99 /plan +█ +148 ms", shown)
    assert re.search(r"RTT 0\.1 +█ +0\.42 ms", shown)
    assert "/h on local" in shown
    assert "local/<west>/a" in shown


def test_a_trend_is_a_line_of_bars():
    assert sparkline(deque([0.0, 0.5, 1.0])) == "▁▅█"
    assert sparkline(deque([0.0])) == "▁"


def test_a_replica_is_ready_from_its_readiness_to_its_end():
    assert list(ready_spans(EVENTS, 200.0)) == [
        ("0.1", 110.0, 150.0), ("0.1", 160.0, 190.0), ("1.1", 170.0, 200.0)
    ]  # fmt: skip


@needs("matplotlib")
def test_a_page_tells_a_pools_life(home, capsys, tmp_path):
    with alive(lay_down(home)):
        for event in EVENTS:
            composition.make_store("planner").append(event)
        assert main.run(["report", "planner", "--into", str(tmp_path / "page.html")]) == 0
    page = (tmp_path / "page.html").read_text()
    assert page.startswith("<!doctype html>")
    assert "At least one replica was ready for" in page
    assert "days before this page was written" in page, "a time has the unit that fits it"
    assert "<svg" in page
    assert "local/&lt;west&gt;/a" in page, "what comes from elsewhere is escaped"
    assert "148 ms" in page
    assert not re.findall(r'(?:src|href)="https?:', page), "it needs no other file"
    assert "done: wrote" in capsys.readouterr().err


@needs("matplotlib")
def test_of_the_time_since_a_pools_last_word_a_page_says_nothing(home, tmp_path):
    lay_down(home, age_s=86_400.0)
    now = time.time()
    composition.make_store("planner").append(Event(now - 90_010.0, EventKind.READY, 0, 1))
    assert main.run(["report", "planner", "--into", str(tmp_path / "page.html")]) == 0
    assert "of the last 1 h 0 min" in (tmp_path / "page.html").read_text()


@needs("matplotlib", "browser")
def test_a_browser_shows_the_page_whole_narrow_wide_and_dark(home, tmp_path):
    """Nothing is wider than the window, figures are drawn, and dark colours are turned round."""
    with alive(lay_down(home)):
        for event in EVENTS:
            composition.make_store("planner").append(event)
        assert main.run(["report", "planner", "--into", str(tmp_path / "page.html")]) == 0
    with browser(tmp_path / "profile") as driver:
        for width in (360, 1400):
            window = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
            driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", window)
            driver.get((tmp_path / "page.html").as_uri())
            assert driver.execute_script("return innerWidth") == width
            assert driver.execute_script("return document.documentElement.scrollWidth") <= width
            heights = driver.execute_script(
                "return [...document.querySelectorAll('svg')]"
                ".map(one => one.getBoundingClientRect().height)"
            )
            assert heights
            assert min(heights) > 50
        look = "return getComputedStyle(document.querySelector('svg')).filter"
        assert driver.execute_script(look) == "none"
        dark = {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}
        driver.execute_cdp_cmd("Emulation.setEmulatedMedia", dark)
        assert "invert" in driver.execute_script(look)
        assert [line for line in driver.get_log("browser") if line["level"] == "SEVERE"] == []
