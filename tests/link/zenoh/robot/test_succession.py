"""A connection makes way for one with new credentials, and whoever sends does not notice."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from fogft.link import probe_frames
from fogft.link.port import Peer, ProbeAnswer
from fogft.link.zenoh.robot import link as links
from fogft.link.zenoh.robot.connection import Shared
from fogft.link.zenoh.settings import LinkSettings
from fogft.model.credentials import CredentialPaths
from fogft.model.replica import ReplicaId

UID = "0123456789abcdef"
ID = b"i" * 16
ANSWER = probe_frames.encode_probe_answer(ProbeAnswer(slot=0, generation=1, incarnation="x"))


class Connection:
    """One that is up at once; its attempts note what they are told."""

    made: list[Connection]

    def __init__(self, *_: Any) -> None:
        self.made.append(self)
        self.certificate = b"%d" % len(self.made)
        self.lost_because, self.told = "", b""
        still = SimpleNamespace(stalled=lambda *_, **__: False)
        self.flow = SimpleNamespace(look=lambda *_: 0.0, thin=False, progress=still)
        self.told_to: list[object] = []
        self.attempts = SimpleNamespace(
            window=[ID],  # something is under way
            watched=False,
            round_trip_s=0.0,
            offer=lambda *_, **__: True,
            send=lambda: self.told_to.append("send"),
            forget=self.told_to.append,
            sweep=lambda: False,
            look=lambda now: 0.0,
        )

    def alive(self) -> bool:
        return True

    def begin(self) -> bool:
        return True

    def probe(self, key: str, payload: bytes, heard: Any) -> None:
        heard(ANSWER)

    def close(self) -> None:
        pass


class Owner:
    """Sends what it has offered, and forgets a request, as soon as it hears of a new connection."""

    def __init__(self) -> None:
        self.up = [threading.Event(), threading.Event()]

    def changed(self, link: links.ZenohLink) -> None:
        if link.certificate == b"2" and not self.up[1].is_set():
            link.send()
            link.forget(ID)
        if link.certificate:
            self.up[int(link.certificate) - 1].set()


@pytest.fixture
def link(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[links.ZenohLink, Owner]]:
    Connection.made = []
    monkeypatch.setattr(links, "Connection", Connection)
    owner, nowhere = Owner(), CredentialPaths(Path("ca"), Path("crt"), Path("key"))
    shared = Shared(nowhere, "robot", 2.0, LinkSettings(), tell_losers=True)
    peer = Peer(ReplicaId(UID, 0, 1), "h:1", "replica")
    made = links.ZenohLink(shared, peer, {"/s": "k"}, owner, lambda _: None)  # type: ignore[arg-type]
    yield made, owner
    made.close()
    assert made.thread is not None
    made.thread.join(10.0)


def test_the_old_connection_sends_and_forgets_from_the_moment_that_the_new_one_is_up(link):
    """A request would wait there for the next flush, another would keep its room."""
    made, owner = link
    assert owner.up[0].wait(10.0)
    made.renew()
    assert owner.up[1].wait(10.0)
    assert Connection.made[0].told_to == ["send", ID]
