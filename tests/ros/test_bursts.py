"""A server tells where requests that came together begin and end."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from fogft.errors import RosError
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
    srv_name = service_name = "/s"


class NoNodes:
    def answers(self, service: str, client: bytes) -> bool:
        return False


def serving(waiting: list[Any], heard: list[Any], fails: bool = False) -> Server:
    def on_request(payload: bytes, handle: Any) -> None:
        heard.append(payload)
        if fails:
            raise ValueError("of the application")

    ends = Service(), End(waiting), on_request, lambda server: None
    return Server(*ends, on_burst=heard.append, probes=NoNodes())


def numbered(count: int) -> list[tuple[bytes, bytes]]:
    return [(b"%d" % n, b"") for n in range(count)]


def test_one_request_is_no_burst():
    heard: list[Any] = []
    serving(numbered(1), heard).drain()
    assert heard == [b"0"]


def test_a_request_does_not_wait_until_ros_was_asked_for_another():
    """Where they come one at a time; where they came together, it leaves with the others."""
    heard, waiting = [], numbered(1)
    server = serving(waiting, heard)
    asked: list[int] = []
    take = server.take
    server.take = lambda: (asked.append(len(heard)), take())[1]
    server.drain()
    assert asked == [0, 1]
    waiting += numbered(4)
    server.drain()
    assert heard == [b"0", b"0", True, b"1", b"2", b"3", False]
    del heard[:], asked[:]
    waiting += numbered(1)
    server.drain()
    assert (heard, asked) == ([b"0"], [0, 0])


@given(st.lists(st.integers(1, 2 * BURST), min_size=1, max_size=4), st.booleans())
def test_a_burst_is_told_around_its_requests(counts, fails):
    """Also where each request fails. What exceeds it is left for the next turn."""
    heard: list[Any] = []
    waiting: list[Any] = []
    server = serving(waiting, heard, fails)
    in_bursts = False
    for count in counts:
        requests = numbered(count)
        waiting[:], heard[:] = requests, []
        server.drain()
        payloads = [payload for payload, _ in requests]
        expected: list[Any] = [] if in_bursts else [payloads.pop(0)]
        together = payloads[:BURST]
        if len(together) > 1:
            expected += [True, *together, False]
        else:
            expected += together
        assert heard == expected
        assert len(waiting) == max(len(payloads) - BURST, 0)
        in_bursts = len(together) > 1 if together else in_bursts


def test_what_cannot_be_read_ends_a_burst_and_loses_nothing_before_it():
    heard: list[Any] = []
    first, second, third, last = numbered(4)
    server = serving([first, second, third, RosError("garbage"), last], heard)
    server.drain()
    assert heard == [b"0", True, b"1", b"2", False]
    server.drain()
    assert heard[-1] == b"3"


def test_an_error_right_after_the_first_request_does_not_lose_it():
    heard: list[Any] = []
    waiting = [(b"1", b""), RosError("garbage"), (b"2", b"")]
    server = serving(waiting, heard)
    server.drain()
    assert heard == [b"1"]
    server.drain()
    assert heard == [b"1", b"2"]
