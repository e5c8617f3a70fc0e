"""A rendezvous as a process: what it passes on, and what its death does not stop."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fogft.model.credentials import CredentialPaths
from fogft.model.proxy_config import ClientProxyConfig
from fogft.model.replica import Membership
from fogft.pool.credentials.authority import Role
from fogft.proxy.robot.following import Following
from fogft.records import cache as record_cache
from fogft.records.record import Record, RecordKind, SignedRecord, sign_record
from fogft.records.roster import admission_content
from fogft.records.signing import Signer
from tests.fakes.proxy import Clock
from tests.link.wire_pool import POOL_UID, Authority, wait_for
from tests.ports import free_port
from tests.records import certificate_names
from tests.records.rendezvous_pool import Party, Rendezvous, manager_files


@pytest.fixture
def rendezvous(authority: Authority) -> Iterator[Callable[..., Rendezvous]]:
    started: list[Rendezvous] = []

    def start(name: str = "a") -> Rendezvous:
        started.append(Rendezvous(authority, name))
        return started[-1]

    yield start
    for one in started:
        one.kill()


@pytest.fixture
def party() -> Iterator[Callable[..., Party]]:
    made: list[Party] = []

    def make(files: CredentialPaths, *places: Rendezvous, cache: Path | None = None) -> Party:
        made.append(Party(files, *(place.endpoint for place in places), cache=cache))
        return made[-1]

    yield make
    for one in made:
        one.client.close()


def test_everybody_learns_who_is_where(authority, rendezvous, party):
    """A manager, two replicas and two robots that know nothing but the rendezvous."""
    place = rendezvous()
    robots = [party(authority.robot(name), place) for name in ("r1", "r2")]
    manager = party(manager_files(authority), place)
    manager.admit(1, (0, 1), (1, 1))
    for slot in (0, 1):
        party(authority.replica(slot), place).announce(slot, 1, f"10.0.0.{slot}:7447")
    for one in (*robots, manager):
        wait_for(
            lambda one=one: (
                one.endpoint(0) == "10.0.0.0:7447" and one.endpoint(1) == "10.0.0.1:7447"
            )
        )
    robot = robots[0]
    assert robot.client.known.seen_host == "127.0.0.1"
    party(authority.replica(0, 2), place).announce(0, 2, "10.9.9.9:1")
    wait_for(lambda: robot.orders().get(("slot", "0")) == (2, 1))
    assert robot.endpoint(0) == ""  # the launch that is admitted says nothing any more
    manager.admit(2, (0, 2), (1, 1))
    wait_for(lambda: robot.endpoint(0) == "10.9.9.9:1")


def test_a_revoked_robot_hears_no_more_over_the_connection_that_it_has(
    authority, rendezvous, party
):
    place = rendezvous()
    eve, bob, manager = (
        party(files, place)
        for files in (authority.robot("eve"), authority.robot("bob"), manager_files(authority))
    )
    wait_for(lambda: eve.client.known.connected and bob.client.known.connected)
    names = [certificate_names.robot(POOL_UID, "eve")]
    manager.client.publish(RecordKind.REVOCATION, "", 1, {"names": names})
    wait_for(lambda: not eve.client.known.connected)
    manager.admit(1, (0, 1))
    wait_for(lambda: bob.client.known.of(RecordKind.ADMISSION))
    assert not eve.client.known.of(RecordKind.ADMISSION)


def test_a_replica_that_moves_without_end_is_dialled_once_a_second(
    authority, rendezvous, party, tmp_path
):
    """Each new address costs a new connection, and the others' requests wait for that."""
    place, clock = rendezvous(), Clock()
    party(manager_files(authority), place).admit(1, (0, 1))
    config = ClientProxyConfig(
        pool="p", pool_uid=POOL_UID, credentials=authority.robot("ada"), services=(), robot="ada",
        membership=tmp_path / "a", status=tmp_path / "b", lock=tmp_path / "c",
        rendezvous=(place.endpoint,),
    )  # fmt: skip
    following, witness = Following(config, clock), party(authority.robot("bob"), place)
    wait_for(lambda: following.look() is not None)
    liar, found = party(authority.replica(0), place), set[str]()

    def moves(port: int) -> None:
        liar.announce(0, 1, f"10.0.0.1:{port}")
        wait_for(lambda: witness.endpoint(0) == f"10.0.0.1:{port}")
        if (seen := following.look()) is not None:
            found.update(member.endpoint for member in seen.members)

    for port in range(1, 20):
        moves(port)
    assert len(found) <= 5

    def arrives() -> bool:
        clock.now += 1.0
        seen = following.look()
        return seen is not None and seen.members[0].endpoint == "10.0.0.1:19"

    wait_for(arrives)
    following.close()


@pytest.mark.parametrize("forgets", [False, True])
def test_what_joins_while_it_is_dead_is_known_once_it_is_back(
    authority, rendezvous, party, forgets
):
    """Also where it comes back with an empty memory: whoever connects fills it."""
    place = rendezvous()
    robot = party(authority.robot(), place)
    manager = party(manager_files(authority), place)
    manager.admit(1, (0, 1))
    replica = party(authority.replica(0), place)
    replica.announce(0, 1, "10.0.0.1:1")
    wait_for(lambda: robot.endpoint(0) == "10.0.0.1:1")
    place.kill()
    wait_for(lambda: robot.client.known.connected == 0)
    assert robot.endpoint(0) == "10.0.0.1:1"
    joined = party(authority.replica(1), place)
    joined.announce(1, 1, "10.0.0.2:1")
    manager.admit(2, (0, 1), (1, 1))
    replica.announce(0, 1, "10.0.0.9:9")
    if forgets:
        place.forget()
    place.start()
    wait_for(lambda: robot.endpoint(1) == "10.0.0.2:1" and robot.endpoint(0) == "10.0.0.9:9")


def test_a_frozen_rendezvous_is_given_up_and_found_again(authority, rendezvous, party):
    """It keeps its port and its connections, and says nothing."""
    place = rendezvous()
    robot, manager = party(authority.robot(), place), party(manager_files(authority), place)
    manager.admit(1)
    wait_for(robot.membership)
    place.signal(signal.SIGSTOP)
    wait_for(lambda: robot.client.known.connected == 0)
    manager.admit(2, (3, 1))
    place.signal(signal.SIGCONT)
    wait_for(lambda: robot.endpoint(3) == "")


def test_one_of_two_suffices_and_callers_carry_records_across(authority, rendezvous, party):
    """The manager reaches only one, a robot only the other; a third caller reaches both."""
    a, b = rendezvous("a"), rendezvous("b")
    manager, robot = party(manager_files(authority), a), party(authority.robot("far"), b)
    both = party(authority.robot("both"), a, b)
    manager.admit(1, (0, 1))
    wait_for(lambda: robot.endpoint(0) == "")
    a.kill()
    wait_for(lambda: both.client.known.connected == 1)
    party(authority.replica(0), b).announce(0, 1, "10.0.0.1:1")
    for one in (robot, both):
        wait_for(lambda one=one: one.endpoint(0) == "10.0.0.1:1")


def test_an_address_that_no_resolver_takes_stops_no_other_and_no_writer(
    authority, rendezvous, party
):
    """As it may stand in a file that an older version wrote."""
    place = rendezvous()
    manager = Party(manager_files(authority), "meet..example.org:7450", place.endpoint)
    try:
        robot = party(authority.robot("r1"), place)
        for version in (1, 2):
            manager.admit(version, (version, 1))
            wait_for(lambda version=version: robot.endpoint(version) is not None)
    finally:
        manager.client.close()


def test_one_that_is_started_elsewhere_is_found_by_its_name_or_in_the_list(
    authority, party, monkeypatch
):
    """Another machine, with no memory; what joined meanwhile is known there too.

    The robot knows it by a name, which means another address then; the manager and the replica
    by a list, where the new one is the second.
    """
    hosts, port = ["127.0.0.1", "127.0.0.2"], free_port()
    find, at = socket.getaddrinfo, [hosts[0]]

    def found(host: str, *rest: object, **named: object) -> object:
        return find(at[0] if host == "meet.test" else host, *rest, **named)

    monkeypatch.setattr(socket, "getaddrinfo", found)
    first = Rendezvous(authority, "a", endpoint=f"{hosts[0]}:{port}")
    listed = [f"{host}:{port}" for host in hosts]
    robot = Party(authority.robot(), f"meet.test:{port}")
    manager = Party(manager_files(authority), *listed)
    others = [robot, manager]
    try:
        manager.admit(1, (0, 1))
        wait_for(lambda: robot.endpoint(0) == "")
        first.kill()
        wait_for(lambda: not robot.client.known.connected and not manager.client.known.connected)
        manager.admit(2, (0, 1), (1, 1))
        others.append(Party(authority.replica(1), *listed))
        others[-1].announce(1, 1, "10.0.0.2:1")
        at[0] = hosts[1]
        second = Rendezvous(authority, "b", endpoint=listed[1])
        try:
            wait_for(lambda: robot.endpoint(1) == "10.0.0.2:1")
        finally:
            second.kill()
    finally:
        first.kill()
        for one in others:
            one.client.close()


def test_a_restarted_writer_goes_on_above_what_it_said(authority, rendezvous, party):
    """It remembers nothing: it hears its former record and says what holds now."""
    place = rendezvous()
    robot, manager = party(authority.robot(), place), party(manager_files(authority), place)
    manager.admit(1, (0, 1))
    files = authority.replica(0)
    first = party(files, place)
    for port in range(1, 6):
        first.announce(0, 1, f"10.0.0.1:{port}")
    wait_for(lambda: robot.endpoint(0) == "10.0.0.1:5")
    before = robot.orders()["slot", "0"]
    first.client.close()
    party(files, place).announce(0, 1, "10.0.0.2:1")
    wait_for(lambda: robot.endpoint(0) == "10.0.0.2:1")
    assert robot.orders()["slot", "0"] > before


def test_a_renewed_certificate_signs_what_the_old_one_did(authority, rendezvous, party):
    """The records of a process whose certificate was exchanged outlive the old one."""
    place = rendezvous()
    robot, manager = party(authority.robot(), place), party(manager_files(authority), place)
    manager.admit(1, (0, 1))
    replica = party(authority.replica(0), place)
    replica.announce(0, 1, "10.0.0.1:1")
    wait_for(lambda: robot.endpoint(0) == "10.0.0.1:1")
    authority.replica(0)  # written over the old pair
    wait_for(lambda: robot.orders()["slot", "0"] == (1, 2))
    assert robot.endpoint(0) == "10.0.0.1:1"


def test_an_old_manager_does_not_win(authority, rendezvous, party):
    """One that was out of reach for long comes back and says what it always said."""
    place = rendezvous()
    robot = party(authority.robot(), place)
    files = manager_files(authority)
    new, old = party(files, place), party(files)
    new.admit(1, (0, 2), epoch=2)
    wait_for(robot.membership)
    old.admit(99, (0, 1), epoch=1)
    wait_for(old.membership)
    old.client.close()
    late = party(files, place)
    late.admit(99, (0, 1), epoch=1)
    wait_for(lambda: late.orders().get(("admission", "")) == (2, 1))
    assert robot.orders()["admission", ""] == (2, 1)


# -- the cache ----------------------------------------------------------------------------------


def test_a_party_starts_from_its_cache_with_nobody_to_ask(authority, rendezvous, party, tmp_path):
    place, cache = rendezvous(), tmp_path / "records.json"
    robot = party(authority.robot(), place, cache=cache)
    manager = party(manager_files(authority), place)
    manager.admit(1, (0, 1))
    party(authority.replica(0), place).announce(0, 1, "10.0.0.1:1")
    wait_for(lambda: robot.endpoint(0) == "10.0.0.1:1")
    wait_for(lambda: cache.exists() and len(record_cache.read(cache)) == 2)
    place.kill()
    again = Party(authority.robot(), place.endpoint, cache=cache, start=False)
    assert again.endpoint(0) == "10.0.0.1:1"


def test_a_damaged_cache_costs_only_itself(authority, rendezvous, party, tmp_path):
    """Cut anywhere, changed anywhere, of another version: the party starts, and asks."""
    place, cache = rendezvous(), tmp_path / "records.json"
    manager = party(manager_files(authority), place, cache=cache)
    manager.admit(1, (0, 1))
    wait_for(lambda: cache.exists() and len(record_cache.read(cache)) == 1)
    whole = cache.read_bytes()
    damaged = [whole[: len(whole) // 2], b"", b"\xff\x00", b"[1]", b"null",
               whole.replace(b'"version": 1', b'"version": 2'),
               whole.replace(b"slot", b"slop", 1)]  # fmt: skip
    for content in damaged:
        cache.write_bytes(content)
        lone = Party(authority.robot(), cache=cache, start=False)
        assert lone.membership() is None
    cache.write_bytes(damaged[0])
    robot = party(authority.robot(), place, cache=cache)
    wait_for(lambda: robot.endpoint(0) == "")
    wait_for(lambda: cache.read_bytes() != damaged[0])


def test_a_cached_record_that_was_tampered_with_is_not_believed(authority, party, tmp_path):
    """Its checksum is right; its signature is not."""
    cache = tmp_path / "records.json"
    manager = party(manager_files(authority), cache=cache)
    manager.admit(1, (0, 1))
    wait_for(lambda: cache.exists())
    one = record_cache.read(cache)[0]
    body = one.body.replace(b'"sequence":1', b'"sequence":9')
    assert body != one.body
    changed = SignedRecord(body, one.certificate, one.signature)
    record_cache.write(cache, [changed])
    lone = Party(authority.robot(), cache=cache, start=False)
    assert lone.membership() is None
    assert lone.client.status()["offered"] == {"refused_forged": 1}


def test_what_a_certificate_signed_outlives_it_in_the_cache_only(
    authority, rendezvous, party, tmp_path
):
    """A manager dead for a year stops no robot that knew it, and tells nobody anything new."""
    cache, place = tmp_path / "records.json", rendezvous()
    name = certificate_names.manager(POOL_UID)
    expired = authority.issue(name, Role.MANAGER, days=-0.5)
    content = admission_content(Membership("p", POOL_UID, 1, 1, ()))
    record = Record(POOL_UID, RecordKind.ADMISSION, "", 1, 1, content)
    record_cache.write(cache, [sign_record(record, Signer(expired.certificate, expired.key))])
    robot = party(authority.robot(), place, cache=cache)
    assert robot.membership() == Membership("p", POOL_UID, 1, 1, ())
    wait_for(lambda: place.count("offered", "refused_expired"))
    assert place.status()["records"] == 0


def test_its_memory_survives_its_death(authority, rendezvous, party):
    """With every writer gone, a rendezvous that was killed and restarted still knows."""
    place = rendezvous()
    manager = party(manager_files(authority), place)
    manager.admit(7, (0, 1))
    wait_for(lambda: place.count("offered", "accepted") == 1)
    wait_for((place.folder / "records.json").exists)
    manager.client.close()
    place.kill()
    place.start()
    robot = party(authority.robot(), place)
    wait_for(lambda: robot.orders().get(("admission", "")) == (1, 7))


def test_it_ends_at_a_signal_and_tells_a_taken_port(rendezvous):
    place = rendezvous()
    taken = subprocess.run(
        [sys.executable, "-m", "fogft", "rendezvous", "--config", str(place.config)],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert taken.returncode == 1
    assert f"cannot listen at `{place.endpoint}`" in taken.stderr
    assert "Traceback" not in taken.stderr
    place.signal(signal.SIGTERM)
    assert place.process.wait(30) == 0
