"""The first message of a connection comes whole and in time, or is refused."""

from __future__ import annotations

import socket
import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.link.dial_out import tunnel
from fogft.records import frames
from fogft.records.record import RecordError

NONCE = bytes(range(frames.NONCE_BYTES))
WHOLE = frames.challenge(NONCE, "10.0.0.1")


@pytest.fixture
def ends():
    near, far = socket.socketpair()
    with near, far:
        yield near, far


@given(st.integers(1, len(WHOLE)), st.binary(max_size=50))
def test_it_comes_however_it_is_cut_and_whatever_follows(at, more):
    near, far = socket.socketpair()
    with near, far:
        sender = threading.Thread(
            target=lambda: [far.sendall(part) for part in (WHOLE[:at], WHOLE[at:] + more) if part]
        )
        sender.start()
        found = tunnel.receive(near, 4096, 30.0)
        sender.join()
    assert frames.read_challenge(found)[0] == NONCE


def test_who_sends_byte_by_byte_has_no_longer_than_others(ends):
    """Each byte comes well within the time: all of them together do not."""
    near, far = ends
    stop = threading.Event()

    def drip():
        for byte in bytes((0, 0, 0x0F, 0)) + bytes(1000):  # it says that 3840 bytes follow
            far.sendall(bytes((byte,)))
            if stop.wait(0.02):
                return

    dripping = threading.Thread(target=drip)
    dripping.start()
    began = time.monotonic()
    with pytest.raises(TimeoutError):
        tunnel.receive(near, 4096, 0.2)
    assert time.monotonic() - began >= 0.2
    stop.set()
    dripping.join()


def test_who_leaves_or_babbles_is_told_apart(ends):
    near, far = ends
    far.sendall(b"\xff" * 500)
    with pytest.raises(RecordError):
        tunnel.receive(near, 4096, 5.0)
    near, far = socket.socketpair()
    with near:
        far.close()
        with pytest.raises(EOFError):
            tunnel.receive(near, 4096, 5.0)
