"""What a manager with a rendezvous in its pool file signs, over epochs and addresses."""

from __future__ import annotations

import asyncio
import tempfile
import threading
from pathlib import Path
from typing import Any

import pytest

from fogft.errors import StateError
from fogft.model.credentials import CredentialPaths, Holder, Role
from fogft.model.membership import members_of
from fogft.model.replica import Machine, MachinePhase, Member, Membership, Placement, ReplicaId
from fogft.model.spec import PoolSpec, ServiceSpec
from fogft.pool.credentials import authority
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.manager.announcing import ManagerRecords
from fogft.reason_words import words
from fogft.records import cache
from fogft.records.exchange import Exchange
from fogft.records.record import RecordKind, read_body
from fogft.records.record_set import RecordSet
from fogft.records.roster import ServingLease, admission, lease
from fogft.records.server import RendezvousServer
from fogft.records.signing import Verifier
from tests.link.wire_pool import wait_for
from tests.records import certificate_names

UID = "0123456789abcdef"
LEASE = ServingLease(1e9, 86_400.0)


class Place:
    """A rendezvous in a thread."""

    def __init__(self, folder: Path) -> None:
        name = certificate_names.rendezvous(UID, "a")
        authority.write(authority.issue(folder, name, role=Role.RENDEZVOUS), folder, "rendezvous")
        files = CredentialPaths(
            folder / "ca.crt", folder / "rendezvous.crt", folder / "rendezvous.key"
        )
        verify = Verifier(files.ca)
        self.records = RecordSet(UID, verify)
        self._server = RendezvousServer("127.0.0.1:0", files, verify, Exchange(self.records))
        self._server.bind()
        self.endpoint = self._server.endpoint
        self._loop = asyncio.new_event_loop()
        self._task = self._loop.create_task(self._server.serve())
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        self._loop.run_until_complete(asyncio.gather(self._task, return_exceptions=True))
        self._loop.close()

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._task.cancel)
        self._thread.join()

    def admitted(self) -> Membership | None:
        held = self.records.get(RecordKind.ADMISSION)
        return None if held is None else admission(held.record)


@pytest.fixture
def paths(tmp_path):
    made = PoolPaths(tmp_path)
    authority.create_authority(made.credentials, UID)
    return made


@pytest.fixture
def place(paths):
    made = Place(paths.credentials)
    yield made
    made.close()


def membership(epoch: int, version: int, *slots: int, revoked: tuple[str, ...] = ()) -> Membership:
    members = tuple(Member(ReplicaId(UID, slot, 1), "10.0.0.1:1") for slot in slots)
    return Membership("p", UID, epoch, version, members, frozenset(revoked))


def test_every_change_is_published_and_the_next_manager_goes_on(paths, place):
    first = ManagerRecords(paths, UID, 1)
    first.look((place.endpoint,), membership(1, 1), LEASE)
    wait_for(lambda: place.admitted() == membership(1, 1))
    first.look((place.endpoint,), membership(1, 2, 0, 1), LEASE)
    wait_for(lambda: place.admitted() == membership(1, 2, 0, 1))
    assert first.trouble is None
    first.close()
    second = ManagerRecords(paths, UID, 2)
    second.look((place.endpoint,), membership(2, 1, 0), LEASE)
    wait_for(lambda: place.admitted() == membership(2, 1, 0))
    second.close()
    assert {r.body for r in cache.read(paths.manager_records)} == {
        r.body for r in place.records.lacking({})
    }


def test_a_slow_disk_leaves_no_older_records_than_those_of_the_end(paths, place, monkeypatch):
    """What is being written when it ends would take the place of what is written last."""
    begun, go_on, done = (threading.Event() for _ in range(3))

    def slow(*given: Any) -> None:
        if begun.is_set():
            return cache.write(*given)
        begun.set()
        go_on.wait(30)
        cache.write(*given)
        return done.set()

    monkeypatch.setattr("fogft.records.client.write", slow)
    manager = ManagerRecords(paths, UID, 1)
    manager.look((place.endpoint,), membership(1, 1), LEASE)
    assert begun.wait(30)
    manager.look((place.endpoint,), membership(1, 2, 0), LEASE)
    wait_for(lambda: place.admitted() == membership(1, 2, 0))
    closing = threading.Thread(target=manager.close)
    closing.start()
    closing.join(0.2)  # or until then, where it has to wait
    go_on.set()
    closing.join()
    assert done.wait(30)
    assert {r.body for r in cache.read(paths.manager_records)} == {
        r.body for r in place.records.lacking({})
    }


@pytest.mark.parametrize("count", [1, 4000])
def test_revocations_are_published_however_many(paths, place, count):
    gone = [Holder(Role.ROBOT, "eve", number, UID).common_name for number in range(1, count + 1)]
    manager = ManagerRecords(paths, UID, 1)
    manager.look((place.endpoint,), membership(1, 1, 0, revoked=gone), LEASE)
    wait_for(lambda: place.records.revoked == set(gone))
    manager.close()


def test_without_a_rendezvous_the_lease_is_signed_for_the_client_proxy_to_pass_on(paths):
    """A new one each minute, or sooner where it is short; never one for each tick."""
    manager = ManagerRecords(paths, UID, 1)
    sequences = []
    for after_s in (0.0, 1.0, 30.0, 59.0, 60.0, 61.0, 200.0):
        manager.look((), membership(1, 1), ServingLease(1e9 + after_s, 86_400.0))
        sequences.append(read_body(cache.read(paths.announcements)[0]).sequence)
    assert sequences == [1, 1, 1, 1, 2, 2, 3]
    manager.look((), membership(1, 1), ServingLease(1e9 + 203.0, 30.0))
    assert lease(read_body(cache.read(paths.announcements)[0])) == ServingLease(1e9 + 203.0, 30.0)
    assert not paths.manager_records.exists()


def test_a_full_disk_holds_no_lease_back(paths, place, monkeypatch):
    """The client proxy finds it in the old file, and a rendezvous needs no file at all."""
    manager = ManagerRecords(paths, UID, 1)
    manager.look((place.endpoint,), membership(1, 1), LEASE)

    def full(**_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "mkstemp", full)
    later = ServingLease(LEASE.at + 60.0, LEASE.lasts_s)
    manager.look((place.endpoint,), membership(1, 2, 0), later)
    assert lease(read_body(cache.read(paths.announcements)[0])) == later
    paths.announcements.unlink()
    latest = ServingLease(LEASE.at + 120.0, LEASE.lasts_s)
    for version in (3, 4):  # it is tried again, and said again
        with pytest.raises(StateError, match=r"announcements\.json` cannot be written: No space"):
            manager.look((place.endpoint,), membership(1, version, 0), latest)
        wait_for(lambda version=version: place.admitted() == membership(1, version, 0))
    wait_for(lambda: lease(place.records.get(RecordKind.LEASE).record) == latest)
    monkeypatch.undo()
    manager.look((place.endpoint,), membership(1, 4, 0), latest)
    assert lease(read_body(cache.read(paths.announcements)[0])) == latest
    manager.close()


def test_it_says_when_none_can_be_reached_and_follows_a_changed_file(paths, place):
    manager = ManagerRecords(paths, UID, 1)
    manager.look(("127.0.0.1:1",), membership(1, 1, 0), LEASE)
    wait_for(lambda: "refused" in words(manager.trouble).lower())
    manager.look((place.endpoint,), membership(1, 1, 0), LEASE)
    wait_for(lambda: place.admitted() == membership(1, 1, 0))
    manager.close()


def test_a_replica_whose_address_the_cloud_does_not_know_is_admitted_where_it_can_be_found():
    """By its own record or at the door; without either there is nothing to link to."""
    where = Placement("local", "r", "z", "i")
    machine = Machine(ReplicaId(UID, 0, 1), where, MachinePhase.RUNNING, 0.0)
    known = Machine(ReplicaId(UID, 1, 1), where, MachinePhase.RUNNING, 0.0, "10.0.0.1:1")
    services = (ServiceSpec("/a", "std_srvs/srv/SetBool"),)

    def endpoints(**keys: object) -> dict[int, str]:
        spec = PoolSpec("p", services, **keys)
        members = members_of((machine, known), spec, pool_uid=UID)
        return {m.id.slot: m.endpoint for m in members}

    assert endpoints() == {1: "10.0.0.1:1"}
    assert endpoints(rendezvous=("h:1",)) == {0: "", 1: "10.0.0.1:1"}
    assert endpoints(dial_in="h:1") == {0: "", 1: ""}
