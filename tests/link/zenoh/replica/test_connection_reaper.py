"""Which strangers at the port have to go, that their addresses are read right, and how they go."""

from __future__ import annotations

import contextlib
import socket
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.link.zenoh.replica.door import (
    LEAST_AGE_S,
    PATIENCE_S,
    STRANGERS_LIMIT,
    condemned,
)
from fogft.link.zenoh.sockets import address, end

ages = st.lists(st.floats(0, 10), max_size=60)


@given(ages)
def test_the_old_go_and_the_young_stay(ages: list[float]) -> None:
    """Nobody outstays the patience, and nobody is cut off in the middle of a handshake."""
    strangers = {("10.0.0.1", port): -age for port, age in enumerate(ages)}
    gone = set(condemned(strangers, 0.0))
    for peer, since in strangers.items():
        if -since >= PATIENCE_S:
            assert peer in gone
        if -since < LEAST_AGE_S:
            assert peer not in gone


@given(ages)
def test_of_too_many_the_oldest_go(ages: list[float]) -> None:
    """At most the limit is left of those who had time for a handshake; the oldest go first."""
    strangers = {("10.0.0.1", port): -age for port, age in enumerate(ages)}
    gone = condemned(strangers, 0.0)
    left = [since for peer, since in strangers.items() if peer not in gone]
    had_time = [since for since in left if -since >= LEAST_AGE_S]
    assert len(had_time) <= STRANGERS_LIMIT
    assert max((strangers[peer] for peer in gone), default=-99) <= min(had_time, default=0)


@pytest.mark.parametrize(
    ("endpoint", "expected"),
    [
        ("tls/127.0.0.1:7447", ("127.0.0.1", 7447)),
        ("tls/[::1]:7447", ("::1", 7447)),
        ("tls/[::ffff:10.0.0.1]:1", ("10.0.0.1", 1)),
        ("tls/10.0.0.1:1?rel=1#x=y", ("10.0.0.1", 1)),
    ],
)
def test_addresses_are_told_as_the_kernel_tells_them(
    endpoint: str, expected: tuple[str, int]
) -> None:
    assert address(endpoint) == expected


def test_what_is_ended_lets_nobody_wait_for_a_peer_that_takes_nothing() -> None:
    """Closed as Zenoh closes it, which would wait 10 s: the peer is reset at once instead."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        near = socket.create_connection(server.getsockname())
        far, _ = server.accept()
    with near, far:
        near.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 60))
        near.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while near.send(bytes(1 << 16)):
                pass
        with near.dup() as ours:
            end(ours)
        near.close()
        with pytest.raises(ConnectionResetError):
            _read_all(far)


def _read_all(connection: socket.socket) -> None:
    while connection.recv(1 << 16):
        pass
