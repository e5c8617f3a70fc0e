"""A replica's end that closes."""

from __future__ import annotations

import socket

import pytest

from fogft.link.port import Probe, ProbeAnswer
from fogft.link.zenoh import sockets
from fogft.link.zenoh.replica.listener import ZenohListener
from fogft.model.replica import ReplicaId
from tests.link.wire_pool import POOL_UID, Authority, keys


def test_takes_nobody_in_again(authority: Authority, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a robot whose connection it ends is back before it is closed, and is lost once more."""
    listener = ZenohListener("127.0.0.1:0", authority.replica(), ReplicaId(POOL_UID, 0, 1))
    host, _, port = listener.endpoint.partition(":")

    def answer(_: Probe) -> ProbeAnswer:
        return ProbeAnswer(slot=0, generation=1, incarnation="", ready=frozenset())

    def comes_back(at: int, within_s: float) -> None:
        refused.append(at)
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((host, at))

    refused: list[int] = []
    monkeypatch.setattr(sockets, "abort_all", comes_back)
    listener.serve(keys(0), lambda incoming: None, answer)
    socket.create_connection((host, int(port))).close()
    listener.close()
    assert refused == [int(port)]


def test_does_not_count_its_own_refusal(authority: Authority, monkeypatch) -> None:
    """Zenoh tells of a port that takes nobody any more as of a handshake that failed."""
    said = ["a stranger's"]

    class Handshakes:
        def refusals(self) -> list[str]:
            told = said.copy()
            said.clear()
            return told

    listener = ZenohListener(
        "127.0.0.1:0", authority.replica(), ReplicaId(POOL_UID, 0, 1), handshakes=Handshakes()
    )
    monkeypatch.setattr(sockets, "refuse", lambda port: said.append("our own"))
    listener.serve(keys(0), lambda incoming: None, lambda probe: None)
    listener.close()
    assert (said, listener.counters()["handshakes_refused"]) == ([], 1)
