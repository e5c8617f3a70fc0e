"""A server tells where requests that came together begin and end."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from fogft.core.errors import RosError
from fogft.ros.entities import BURST, Server


class End:
    """A service's end from which requests, or errors, are taken."""

    def __init__(self, waiting: list[Any]) -> None:
        self.waiting = waiting

    def take(self) -> Any:
        if not self.waiting:
            return None
        taken = self.waiting.pop(0)
        if isinstance(taken, RosError):
            raise taken
        return taken

    def respond(self, handle: Any, payload: bytes) -> None:
        raise AssertionError("nothing is answered here")

    def close(self) -> None:
        pass


class Service:
    handle = None
    srv_name = "/s"


def drained(waiting: list[Any], heard: list[Any], fails: bool = False) -> Server:
    def on_request(payload: bytes, handle: Any) -> None:
        heard.append(payload)
        if fails:
            raise ValueError("of the application")

    end = End(waiting)
    server = Server(Service(), end, on_request, lambda server: None, heard.append)
    server.drain()
    return server


def test_one_request_is_no_burst():
    heard: list[Any] = []
    drained([(b"1", b"")], heard)
    assert heard == [b"1"]


@given(st.integers(2, 2 * BURST), st.booleans())
def test_a_burst_is_told_around_its_requests(count, fails):
    """Also where each request fails. What exceeds it is left for the next turn."""
    requests = [(b"%d" % n, b"") for n in range(count)]
    waiting, heard = list(requests), []
    drained(waiting, heard, fails)
    taken = min(count, BURST)
    assert heard == [True, *[payload for payload, _ in requests[:taken]], False]
    assert len(waiting) == count - taken


def test_what_cannot_be_read_ends_a_burst_and_loses_nothing_before_it():
    heard: list[Any] = []
    waiting = [(b"1", b""), (b"2", b""), RosError("garbage"), (b"3", b"")]
    drained(waiting, heard)
    assert heard == [True, b"1", b"2", False]
    drained(waiting, heard)
    assert heard[-1] == b"3"


def test_an_error_right_after_the_first_request_does_not_lose_it():
    heard: list[Any] = []
    drained([(b"1", b""), RosError("garbage")], heard)
    assert heard == [b"1"]
