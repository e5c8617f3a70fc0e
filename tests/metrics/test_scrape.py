"""Metrics over plain HTTP: what a scraper gets, and what a bad one does not break."""

from __future__ import annotations

import socket
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest

from fogft.metrics.scrape import Scrape, family
from tests.fakes.threads import no_more


def one():
    return [family("fogft_x", "x", [(1, {})])]


@pytest.fixture
def scrape() -> Iterator[Scrape]:
    made = Scrape(one, {"pool": "p"})
    yield made
    made.close()


def get(endpoint: str, path: str = "/metrics") -> tuple[str, str]:
    with urllib.request.urlopen(f"http://{endpoint}{path}", timeout=60) as response:
        return response.headers["Content-Type"], response.read().decode()


def test_a_scraper_gets_the_text(scrape):
    scrape.at("127.0.0.1:0")
    kind, said = get(scrape.endpoint)
    assert kind.startswith("text/plain; version=0.0.4")
    assert 'fogft_x{pool="p"} 1.0\n' in said


def test_it_moves_and_ends_when_told(scrape):
    scrape.at("127.0.0.1:0")
    first = scrape.endpoint
    scrape.at("localhost:0")
    assert scrape.endpoint != first
    assert get(scrape.endpoint)
    scrape.at("")
    assert scrape.endpoint == ""
    with pytest.raises(urllib.error.URLError):
        get(first)


def test_a_port_that_is_taken_is_logged_and_nothing_is_raised(scrape, caplog):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        scrape.at(f"127.0.0.1:{taken.getsockname()[1]}")
    assert scrape.endpoint == ""
    assert "metrics_not_served" in caplog.text


def test_where_no_thread_can_be_started_nothing_is_served_and_the_port_is_free(scrape, caplog):
    with no_more():
        scrape.at("127.0.0.1:0")
    assert scrape.endpoint == ""
    assert "metrics_not_served" in caplog.text
    scrape.at("localhost:0")
    assert get(scrape.endpoint)


def test_what_cannot_be_measured_is_an_error_of_that_request_only():
    measured = iter([RuntimeError("broken"), one()])

    def measure():
        found = next(measured)
        if isinstance(found, Exception):
            raise found
        return found

    scrape = Scrape(measure, {})
    scrape.at("127.0.0.1:0")
    try:
        with pytest.raises(urllib.error.HTTPError, match="500"):
            get(scrape.endpoint)
        assert get(scrape.endpoint)
    finally:
        scrape.close()


def test_noise_and_silence_cost_others_nothing(scrape):
    """One connection says nothing, one says what is no HTTP; a scraper is served beside them."""
    scrape.at("127.0.0.1:0")
    host, _, port = scrape.endpoint.rpartition(":")
    with (
        socket.create_connection((host, int(port))),
        socket.create_connection((host, int(port))) as noisy,
    ):
        noisy.sendall(b"\x00\xff\x01 noise\r\n\r\n")
        assert get(scrape.endpoint)
