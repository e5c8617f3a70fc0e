"""Who may not come in stands before a rendezvous, or a robot's door: who may comes in past him."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator

import pytest

from fogft.link.dial_out.replica import DialOut
from fogft.link.dial_out.robot import GREETINGS_LIMIT, DialIn
from fogft.metrics.scrape import Scrape, family
from fogft.model.replica import ReplicaId
from fogft.records.accepting import oldest_of_most
from fogft.records.exchange import OF_ONE_LIMIT
from fogft.records.server import HANDSHAKES_LIMIT
from fogft.records.signing import Signer, Verifier
from tests.link.wire_pool import POOL_UID, Authority, wait_for
from tests.records.rendezvous_pool import Party, Rendezvous, manager_files

ELSEWHERE = "127.0.0.66"


@contextlib.contextmanager
def standing(endpoint: str, count: int) -> Iterator[list[socket.socket]]:
    """So many connections of one host that say nothing; those that are ended come again."""
    host, _, port = endpoint.rpartition(":")
    with contextlib.ExitStack() as held:

        def come() -> socket.socket:
            return held.enter_context(
                socket.create_connection((host, int(port)), 10.0, source_address=(ELSEWHERE, 0))
            )

        yield [come() for _ in range(count)]


@pytest.fixture
def rendezvous(authority: Authority) -> Iterator[Rendezvous]:
    place = Rendezvous(authority, "a")
    manager = Party(manager_files(authority), place.endpoint)
    manager.admit(5, (0, 2))
    yield place
    manager.client.close()
    place.kill()


def test_silent_strangers_keep_no_robot_from_a_rendezvous(
    authority: Authority, rendezvous: Rendezvous
) -> None:
    """They use up the room for those who have not greeted: the oldest of their host makes way."""
    with standing(rendezvous.endpoint, 2 * HANDSHAKES_LIMIT) as strangers:
        ada = Party(authority.robot("ada"), rendezvous.endpoint)
        wait_for(ada.membership)
        strangers[-1].setblocking(False)
        with pytest.raises(BlockingIOError):  # its time to greet is not over
            strangers[-1].recv(1)
        wait_for(lambda: rendezvous.count("port", "greeting_crowded") >= HANDSHAKES_LIMIT)
        assert strangers[0].recv(1) == b""
        ada.client.close()


def test_a_robot_that_calls_a_rendezvous_often_has_its_oldest_calls_ended(
    authority: Authority, rendezvous: Rendezvous
) -> None:
    """Nobody uses up the room of all others with one certificate."""
    eve = authority.robot("eve")
    calls = [Party(eve, rendezvous.endpoint) for _ in range(2 * OF_ONE_LIMIT)]
    wait_for(lambda: rendezvous.status()["messages"].get("surplus", 0) >= OF_ONE_LIMIT)
    assert rendezvous.status()["callers"] <= OF_ONE_LIMIT + 1  # and the manager
    for one in calls:
        one.client.close()


def test_silent_strangers_keep_no_replica_from_a_door(authority: Authority) -> None:
    files = authority.replica()
    door = DialIn("127.0.0.1:0", POOL_UID, Verifier(files.ca))
    replica = DialOut("127.0.0.1:1", POOL_UID, Signer(files.certificate, files.key))
    try:
        with standing(door.endpoint, 2 * GREETINGS_LIMIT):
            replica.follow([door.endpoint])
            wait_for(lambda: door.waiting().get(ReplicaId(POOL_UID, 0, 1)))
        assert door.counters()["greeting_crowded"] >= GREETINGS_LIMIT
    finally:
        replica.close()
        door.close()


def test_scrapers_that_say_nothing_keep_no_other_out_and_few_threads() -> None:
    scrape = Scrape(lambda: [family("fogft_x", "x", [(1, {})])], {})
    scrape.at("127.0.0.1:0")
    host, _, port = scrape.endpoint.rpartition(":")
    try:
        with standing(scrape.endpoint, 20) as silent:
            assert silent[0].recv(1) == b""  # at once, for newer ones came
            with socket.create_connection((host, int(port)), 30.0) as one:
                one.sendall(b"GET /metrics HTTP/1.0\r\n\r\n")
                said = b""
                while part := one.recv(4096):
                    said += part
        assert b"fogft_x 1.0" in said
    finally:
        scrape.close()


@pytest.mark.parametrize(
    ("hosts", "gone"),
    [
        (["a"], 0),
        (["a", "b", "b", "a", "b"], 1),
        (["10.0.0.1", "2001:db8::1", "2001:db8::2"], 1),  # one network
        (["2001:db8:0:1::1", "10.0.0.1", "2001:db8::2", "10.0.0.1"], 1),
    ],
)
def test_the_oldest_of_the_host_that_has_most_makes_way(hosts: list[str], gone: int) -> None:
    assert oldest_of_most(dict(enumerate(hosts))) == gone
