"""What a replica says of itself at the rendezvous, and how often, on a clock of the test's."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from fogft.model.credentials import CredentialPaths
from fogft.model.proxy_config import ServerProxyConfig
from fogft.proxy.replica import announcing
from fogft.proxy.replica.announcing import doors
from fogft.records.client import Known
from fogft.records.record import Record, RecordKind
from fogft.records.roster import slot_state

UID = "0123456789abcdef"


class Records:
    """Remembers what is published, and is seen at a host that a test sets."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.known = Known()
        self.said: list[dict[str, Any]] = []
        self.keys: set[tuple[RecordKind, str, int]] = set()

    def start(self) -> None:
        """There is nobody to call."""

    def publish(
        self, kind: RecordKind, subject: str, generation: int, content: dict[str, Any]
    ) -> None:
        slot_state(Record(UID, kind, subject, generation, 1, content))  # it can be read
        self.keys.add((kind, subject, generation))
        self.said.append(content)


class Scene:
    def __init__(self, patch: pytest.MonkeyPatch, **given: Any) -> None:
        self.records = Records()
        patch.setattr(announcing, "RendezvousClient", lambda *_, **__: self.records)
        patch.setattr(announcing, "Signer", lambda *_: None)
        patch.setattr(announcing, "DialOut", lambda *_: Mock())
        config = ServerProxyConfig(
            pool="arm", pool_uid=UID, credentials=CredentialPaths(Path(), Path(), Path()),
            services=(), slot=1000, generation=3, rendezvous=("rendezvous.example:7450",), **given,
        )  # fmt: skip
        self._presence = announcing.Presence(config, "0.0.0.0:7447")

    def look(self, *ready: str, draining: bool = False) -> Known:
        return self._presence.look(frozenset(ready), draining=draining)


@pytest.fixture
def scene(monkeypatch) -> Scene:
    return Scene(monkeypatch)


def test_it_writes_its_own_slot_and_launch_and_no_other(scene):
    for service in ("/plan", "/move", "/look"):
        scene.look(service)
    assert len(scene.records.said) == 3
    assert scene.records.keys == {(RecordKind.SLOT, "1000", 3)}


def test_endpoint_services_and_state_are_said_as_they_change(scene):
    scene.look()
    scene.look("/plan")
    scene.look("/plan", draining=True)
    said = scene.records.said
    assert [one["services"] for one in said] == [[], ["/plan"], ["/plan"]]
    assert [one["draining"] for one in said] == [False, False, True]


def test_nothing_is_said_twice(scene):
    scene.look("/plan")
    scene.look("/plan")
    assert len(scene.records.said) == 1


@pytest.mark.parametrize(("host", "seen"), [("10.0.0.7", "10.0.0.7"), ("fd00::7", "[fd00::7]")])
def test_an_address_that_it_cannot_know_is_told_or_seen(host, seen, monkeypatch):
    """As it was told it, first; as a rendezvous sees it, the port being its own."""
    scene = Scene(monkeypatch, advertise="vm.example.org:30001")
    scene.look()
    scene.records.known = known = Known(seen_host=host)
    assert scene.look() is known
    assert scene.records.said[0]["observed_endpoint"] == ""
    assert scene.records.said[1]["endpoint"] == "vm.example.org:30001"
    assert scene.records.said[1]["observed_endpoint"] == f"{seen}:7447"


def test_one_that_cannot_be_reached_says_so(monkeypatch):
    scene = Scene(monkeypatch, dial_out=("robot.example:7460",))
    scene.look()
    assert scene.records.said[0]["dials_out"] is True


def test_doors_of_robots_and_gateways_are_found_and_odd_ones_passed_over():
    def record(kind: RecordKind, name: str, door: object) -> Record:
        return Record(UID, kind, name, 1, 1, {"dial_in": door})

    known = Known(
        (
            record(RecordKind.ROBOT, "ada", "ada.example:7460"),
            record(RecordKind.ROBOT, "bob", ""),
            record(RecordKind.ROBOT, "eve", ["x"]),
            record(RecordKind.GATEWAY, "edge", "edge.example:7460"),
        )
    )
    assert doors(known) == ["edge.example:7460", "ada.example:7460"]
