"""Whatever comes in at a gateway's port, and at the doors of gateways and robots.

No process ends, nothing changes, all is counted. The replica's port and the rendezvous are in
`tests/link/zenoh/test_hostile.py` and `tests/records/test_rendezvous_hostile.py`.
"""

from __future__ import annotations

import contextlib
import random
import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from fogft.link import frame
from fogft.link.port import Peer
from fogft.link.zenoh import settings
from fogft.link.zenoh.settings import LinkSettings
from fogft.model import names
from fogft.model.credentials import CredentialPaths
from fogft.model.replica import Member, Membership, ReplicaId
from fogft.records import frames
from fogft.records.record import VERSION, Record, RecordKind
from fogft.records.roster import admission_content
from fogft.records.signing import Signer
from tests.link.wire_pool import POOL_UID, SERVICE, TYPE, Authority, hears, knows, wait_for
from tests.ports import free_port
from tests.proxy.gateway_pool import GatewayPool
from tests.records import certificate_names, hostile
from tests.records.rendezvous_pool import manager_files

pytestmark = pytest.mark.timeout(120)

SLOT = names.gateway_slot("edge")
LIMIT_S = 60.0


class Scene:
    """A robot behind a gateway, each with a door, and somebody hostile."""

    def __init__(self, folder: Path) -> None:
        self.pool = pool = GatewayPool(folder)
        self.authority = pool.authority
        self.doors = {name: f"127.0.0.1:{free_port()}" for name in ("edge", "ada")}
        pool.replica(0)
        self.gateway = pool.gateway("edge", extra=self._door("edge"))
        self.port = self.gateway.endpoint()
        pool.lay_out({"edge": (self.port, ())}, {"ada": ["edge"]})
        self.robot = pool.robot("ada", extra=self._door("ada"))
        wait_for(self.robot.ready, LIMIT_S)
        wait_for(lambda: self.gateway.report()["links"][0]["state"] == "up", LIMIT_S)

    def _door(self, name: str) -> str:
        """Return keys of a configuration; a busy machine shall make nobody suspected."""
        door = f"dial_in: {self.doors[name]}\ndial_in_listen: {self.doors[name]}\n"
        return f"{door}suspect_after_s: 20.0\n"

    def counted(self, event: str) -> int:
        """Return what the gateway has counted at its port."""
        return int(self.gateway.report()["listener"].get(event, 0))

    def at_door(self, name: str) -> dict[str, Any]:
        """Return what the gateway or the robot has counted at its door."""
        report = self.gateway.report() if name == "edge" else self.robot.tell()["report"]
        return dict(report["door"])

    @contextlib.contextmanager
    def counts(self, event: str, times: int) -> Iterator[None]:
        """See that what is done here is counted just so often at the gateway's port."""
        before = self.counted(event)
        yield
        wait_for(lambda: self.counted(event) >= before + times, LIMIT_S)
        assert self.counted(event) == before + times

    def state(self) -> tuple[object, ...]:
        """Return what nobody hostile may change."""
        robot, gateway = self.robot.tell()["report"], self.gateway.report()
        way = [(g["name"], g["state"], g["reopened"]) for g in robot["gateways"]]
        links = [(li["slot"], li["state"], li["reopened"]) for li in gateway["links"]]
        pids = (self.robot.process.pid, gateway["pid"])
        failed = gateway["listener"].get("failed", 0)
        return (way, links, pids, failed, self.robot.process.poll(), self.gateway.process.poll())

    @contextlib.contextmanager
    def unchanged(self) -> Iterator[None]:
        """See that what is done here changes nothing, and that requests go on flowing."""
        before = self.state()
        yield
        self.robot.ask(5)
        self.robot.all_right()
        assert self.state() == before

    def session(self, files: CredentialPaths) -> zenoh.Session:
        """Return the bare session of somebody whose certificate lets him ask the gateway."""
        name = certificate_names.gateway(POOL_UID, "edge")
        peer = Peer(ReplicaId(POOL_UID, SLOT, 1), self.port, name)
        return zenoh.open(settings.to_zenoh(settings.robot_settings(peer, files, LinkSettings())))

    def greeting(self, files: CredentialPaths) -> bytes:
        token = bytes(range(8))
        edge = certificate_names.gateway(POOL_UID, "edge")
        proof = Signer(files.certificate, files.key)(frame.greeted_bytes(token, edge))
        return frame.encode_greeting(frame.Greeting(token, *proof))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    """Shared: no test may change anything, and each says so."""
    made = Scene(tmp_path_factory.mktemp("pool"))
    yield made
    made.pool.close()


def test_bytes_that_are_no_tls_at_a_gateways_port(scene):
    """Random, truncated, oversized, of wrong versions, and none."""
    dice = random.Random(1)
    with scene.unchanged(), scene.counts("handshakes_refused", 2 * len(hostile.JUNK)):
        for make in hostile.JUNK.values():
            for _ in range(2):
                hostile.throw(scene.port, make(dice))


def test_certificates_that_are_no_good_at_a_gateways_port(scene, tmp_path):
    """None, another pool's, an expired one, and those of roles that may not ask."""
    bad = list(hostile.certificates(scene.authority, Authority(tmp_path / "stranger")))
    with scene.unchanged(), scene.counts("handshakes_refused", len(bad)):
        for files in bad:
            hostile.is_turned_away(scene.port, hostile.tls(files, scene.authority.robot().ca))


def test_garbage_after_the_handshake_at_a_gateways_port(scene):
    """The certificate is a robot's; then come messages that are random, cut short, too long."""
    dice, eve = random.Random(2), scene.authority.robot("eve")
    context = hostile.tls(eve, eve.ca)

    def ended() -> int:
        return scene.counted("handshakes_refused") + scene.counted("unauthenticated")

    with scene.unchanged():
        before = ended()
        for length in (None, 0xFFFF, 1):
            content = dice.randbytes(500)
            with hostile.connect(scene.port) as raw, context.wrap_socket(raw) as connection:
                with contextlib.suppress(OSError):
                    connection.sendall(struct.pack("<H", length or len(content)) + content)
                    connection.settimeout(LIMIT_S)
                    while connection.recv(4096):
                        pass
        wait_for(lambda: ended() >= before + 3, LIMIT_S)


def test_frames_that_cannot_be_read_at_a_gateways_port(scene):
    """On every key that a gateway has; not one gets any further."""
    key = names.service_key(POOL_UID, SLOT, SERVICE, TYPE)
    messages = list(hostile.messages(SLOT, key))
    ran = scene.pool.ran()
    with scene.unchanged(), scene.session(scene.authority.robot("eve")) as session:
        hears(session, key)
        knows(session, SLOT)
        with scene.counts("malformed", len(messages)):
            _ = [send(session, payload, attachment) for send, payload, attachment in messages]
        assert scene.pool.ran() == ran


def _manager(
    files: CredentialPaths, kind: RecordKind, sequence: int, content: dict[str, Any]
) -> bytes:
    record = Record(POOL_UID, kind, "", 1, sequence, content)
    return frames.pack([hostile.signed(files, record)])


def test_a_replayed_membership_at_a_gateways_port(scene):
    """A robot brings old ones of the manager's, and revocations of its own making."""
    eve, manager = scene.authority.robot("eve"), manager_files(scene.authority)
    revoked = {"names": [certificate_names.robot(POOL_UID, "gone")]}
    all = {"names": [certificate_names.robot(POOL_UID, "ada")]}
    nobody = admission_content(Membership("p", POOL_UID, 1, 1, ()))
    elsewhere = Member(ReplicaId(POOL_UID, 0, 1), "127.0.0.1:1")
    admitted = admission_content(Membership("p", POOL_UID, 1, 2, (elsewhere,)))
    key, held = names.slot_key(POOL_UID, SLOT, names.RECORDS), []

    with scene.unchanged(), scene.session(eve) as session:
        knows(session, SLOT)

        def bring(payload: bytes) -> None:
            greeting = scene.greeting(eve)
            held.append(session.get(key, payload=payload, attachment=greeting, timeout=LIMIT_S))

        bring(_manager(manager, RecordKind.REVOCATION, 7, revoked))
        bring(_manager(manager, RecordKind.ADMISSION, 2, admitted))
        with scene.counts("records_older", 2):
            bring(_manager(manager, RecordKind.REVOCATION, 6, {"names": []}))
            bring(_manager(manager, RecordKind.ADMISSION, 1, nobody))
        with scene.counts("records_refused", 3):
            bring(_manager(eve, RecordKind.REVOCATION, 8, all))
            bring(_manager(eve, RecordKind.ADMISSION, 8, nobody))
            stranger = scene.authority.issue("manager.manager.1." + "f" * 16, hostile.Role.MANAGER)
            bring(_manager(stranger, RecordKind.REVOCATION, 9, all))


@pytest.mark.parametrize("whose", ["edge", "ada"])
def test_noise_replays_and_impostors_at_a_door(scene, tmp_path, whose):
    """Of a gateway and of a robot: each is counted under its reason, and nobody is let wait."""
    door, dice = scene.doors[whose], random.Random(whose)
    before, expected = scene.at_door(whose), Counter[str]()
    with scene.unchanged():
        for kind, make in hostile.JUNK.items():
            hostile.throw(door, make(dice))
            expected["greeting_failed" if kind == "nothing" else "noise"] += 1
        for message in ({"type": "greeting", "v": 9}, {"type": "greeting", "v": VERSION}):
            hostile.throw(door, frames.frame(message))
        expected.update({"greeting_version": 1, "noise": 1})
        for files, event in hostile.impostors(scene.authority, tmp_path):
            with hostile.greet(door, files) as link:
                assert link.recv(1) == b""
            expected[event] += 1
        replica = scene.authority.replica(0)
        with hostile.greet(door, replica, purpose="rendezvous") as link:
            assert link.recv(1) == b""
        expected["greeting_forged"] += 1

        def counted() -> Counter[str]:
            now = scene.at_door(whose)
            new = Counter({k: n - before.get(k, 0) for k, n in now.items() if k != "waiting"})
            # What is cut off in the middle, and what says nothing readable, are told apart by luck.
            noise = new.pop("greeting_malformed", 0) + new.pop("greeting_failed", 0)
            new["noise"] = noise - expected["greeting_failed"]
            new["greeting_failed"] = expected["greeting_failed"]
            return +new

        wait_for(lambda: counted() == +expected, LIMIT_S)
        assert not scene.at_door(whose)["waiting"]
