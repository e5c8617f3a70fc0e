"""The bytes of topics on the link: what is encoded comes back, and all else is refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.errors import FrameError
from fogft.topics import frames

SESSION = b"session1"
LARGEST = (1 << 63) - 1

sessions = st.binary(min_size=8, max_size=8).filter(lambda session: session != frames.NO_SESSION)
numbers = st.integers(0, LARGEST)
batches = st.lists(st.tuples(numbers, st.binary(max_size=20)), max_size=8)


@given(sessions, numbers, st.binary(max_size=40))
def test_a_message_comes_back_as_it_was(session, number, message):
    assert frames.decode_message(frames.encode_message(session, number, message)) == (
        session,
        number,
        message,
    )


@given(st.binary(min_size=8, max_size=8), numbers)
def test_a_pull_comes_back_as_it_was(session, after):
    """Also one of no session, which asks where to begin."""
    assert frames.decode_pull(frames.encode_pull(session, after)) == (session, after)


@given(sessions, numbers, batches)
def test_a_batch_comes_back_as_it_was(session, after, messages):
    frame = frames.encode_batch(session, after, messages)
    assert frames.decode_batch(frame) == (session, after, messages)


@given(sessions, numbers, batches, st.data())
def test_a_batch_that_is_cut_or_has_more_behind_it_is_refused(session, after, messages, data):
    """Wherever it is cut: never a batch with fewer messages."""
    frame = frames.encode_batch(session, after, messages)
    cut = data.draw(st.integers(0, len(frame) - 1))
    for wrong in (frame[:cut], frame + b"\0"):
        with pytest.raises(FrameError):
            frames.decode_batch(wrong)


@pytest.mark.parametrize(
    ("decode", "frame"),
    [
        (frames.decode_message, frames.encode_message(SESSION, 1, b"")[:-1]),
        (frames.decode_message, b""),
        (frames.decode_message, frames.encode_message(SESSION, LARGEST + 1, b"x")),
        (frames.decode_pull, frames.encode_pull(SESSION, 1)[:-1]),
        (frames.decode_pull, frames.encode_pull(SESSION, 1) + b"\0"),
        (frames.decode_pull, frames.encode_pull(SESSION, LARGEST + 1)),
        (frames.decode_batch, frames.encode_batch(frames.NO_SESSION, 1, [])),
        (frames.decode_batch, frames.encode_batch(SESSION, LARGEST + 1, [])),
        (frames.decode_batch, frames.encode_batch(SESSION, 1, [(LARGEST + 1, b"x")])),
        (
            frames.decode_batch,
            frames.encode_batch(SESSION, 1, [(n, b"") for n in range(frames.BATCH_LIMIT + 1)]),
        ),
    ],
)
def test_what_no_peer_of_ours_sends_is_refused(decode, frame):
    """A number beyond 63 bits would not fit where it is counted on; nor do batches without end."""
    with pytest.raises(FrameError):
        decode(frame)


def test_the_largest_batch_is_taken():
    messages = [(number, b"") for number in range(frames.BATCH_LIMIT)]
    frame = frames.encode_batch(SESSION, LARGEST, messages)
    assert frames.decode_batch(frame) == (SESSION, LARGEST, messages)


@given(st.binary(max_size=60))
def test_of_any_bytes_a_decoder_makes_what_its_encoder_would_send_or_refuses_them(data):
    for decode, encode in (
        (frames.decode_message, frames.encode_message),
        (frames.decode_pull, frames.encode_pull),
        (frames.decode_batch, frames.encode_batch),
    ):
        try:
            found = decode(data)
        except FrameError:
            continue
        assert encode(*found) == data
