"""When compression pays, by a clock of the test's own; and what comes back is what was sent."""

from __future__ import annotations

import contextlib
import os
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.link.compression import LEAST_BYTES, Compression, unpack

THIN, FAST = 125_000.0, 1e9  # 1 Mbit/s; what no zlib keeps up with
TEXT = b"the quick brown fox jumps over the lazy dog " * 3000
NOISE = os.urandom(100_000)


class Clock:
    """Each look at it takes so long."""

    def __init__(self, step_s: float) -> None:
        self.now, self.step_s = 0.0, step_s

    def __call__(self) -> float:
        self.now += self.step_s
        return self.now


@given(st.binary(max_size=5000), st.integers(1, 60))
def test_what_is_packed_is_unpacked(chunk, times):
    payload = chunk * times
    packed = Compression(Clock(0.0)).pack(payload, THIN)
    assert packed is None or (unpack(packed) == payload and len(packed) < len(payload))


def test_text_is_compressed_on_a_thin_link_and_left_alone_on_a_fast_one():
    compression = Compression(Clock(0.001))
    packed = compression.pack(TEXT, THIN)
    assert packed is not None
    assert len(packed) < len(TEXT) / 10
    assert compression.pack(TEXT, 0.0) is not None  # it stood still
    assert compression.pack(TEXT, FAST) is None
    assert compression.pack(TEXT, None) is None
    assert compression.pack(TEXT[: LEAST_BYTES - 1], THIN) is None


def test_compressing_slower_than_the_link_drains_is_given_up():
    """A second for a sample that leaves in a quarter of one."""
    assert Compression(Clock(1.0)).pack(TEXT, THIN) is None


def test_what_does_not_shrink_is_tried_ever_more_rarely():
    """Each trial costs time; of 1000 requests a handful are tried."""
    clock = Clock(0.001)
    compression = Compression(clock)
    assert all(compression.pack(NOISE, THIN) is None for _ in range(1000))
    assert clock.now / clock.step_s / 2 <= 8


def test_a_service_whose_payloads_begin_to_shrink_is_found_out():
    compression = Compression(Clock(0.0))
    for _ in range(5):
        compression.pack(NOISE, THIN)
    assert any(compression.pack(TEXT, THIN) for _ in range(1000))


@given(st.binary(max_size=200))
def test_garbage_is_refused(data):
    """Or happens to be whole; nothing else comes of it."""
    with contextlib.suppress(ValueError):
        assert zlib.compress(unpack(data)) is not None


def test_a_bomb_is_refused_before_it_is_large():
    bomb = zlib.compress(bytes(50_000_000), 9)
    with pytest.raises(ValueError, match="above 1000000 bytes"):
        unpack(bomb, 1_000_000)
    with pytest.raises(ValueError, match="cut short"):
        unpack(bomb[:-5], 60_000_000)
