"""Decompressing: apart from the caller, one peer apart from another, and bounded."""

from __future__ import annotations

import threading
import zlib

from fogft.link.compression import WAITING_BYTES_LIMIT, WAITING_LIMIT, Unpacker
from tests.fakes.threads import no_more
from tests.link.wire_pool import wait_for


def test_payloads_of_one_peer_come_in_order_and_not_by_the_caller() -> None:
    """What cannot be decompressed is told as such, and the next one comes all the same."""
    unpacker, came = Unpacker(), list[bytes | None]()
    threads = set[int]()

    def done(payload: bytes | None) -> None:
        came.append(payload)
        threads.add(threading.get_ident())
        assert payload != b"3"  # whatever it raises costs nobody else

    for number in range(6):
        packed = b"no zlib" if number == 2 else zlib.compress(b"%d" % number)
        assert unpacker.put("ada", packed, done)
    wait_for(lambda: len(came) == 6)
    assert came == [b"0", b"1", None, b"3", b"4", b"5"]
    assert threading.get_ident() not in threads


def test_too_many_of_one_peer_are_declined_and_another_peer_does_not_wait() -> None:
    """By number and by bytes; its thread ends with the last."""
    unpacker, go, others = Unpacker(), threading.Event(), threading.Event()
    packed = zlib.compress(b"x")
    began = threading.Event()

    def stays(payload: bytes | None) -> None:
        began.set()
        go.wait(30.0)

    assert unpacker.put("eve", packed, stays)
    assert began.wait(30.0)
    assert not unpacker.put("eve", bytes(WAITING_BYTES_LIMIT + 1), lambda payload: None)
    for _ in range(WAITING_LIMIT):
        assert unpacker.put("eve", packed, lambda payload: None)
    assert not unpacker.put("eve", packed, lambda payload: None)
    assert unpacker.put("ada", packed, lambda payload: others.set())
    assert others.wait(30.0)
    go.set()
    wait_for(lambda: not [t for t in threading.enumerate() if t.name == "fogft-unpack-eve"])
    assert unpacker.put("eve", packed, lambda payload: None)


def test_where_there_can_be_no_more_threads_the_next_payload_has_one():
    unpacker, came = Unpacker(), threading.Event()
    with no_more():
        assert not unpacker.put("r1", b"packed", lambda _: None)
    assert unpacker.put("r1", b"packed", lambda _: came.set())
    assert came.wait(30)
