"""Whom a port accepts: laws of the judgement, and the kernel's filter that follows from it."""

from __future__ import annotations

import contextlib
import ipaddress
import socket
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.link.zenoh.replica.door import (
    END_EVERY_S,
    HOST_LIMIT,
    KEPT_OUT_S,
    SHUT_LIMIT,
    Door,
)
from fogft.link.zenoh.replica.listen_filter import HOSTS_LIMIT, ListenFilter, instructions

hosts = st.sampled_from([f"10.0.0.{n}" for n in range(6)])
peers = st.sets(st.tuples(hosts, st.integers(1, 30)), max_size=60)
looks = st.lists(st.tuples(peers, st.floats(0.01, 20.0)), max_size=20)


@given(looks, peers)
def test_a_host_is_kept_out_exactly_while_it_has_too_many_and_a_while_after(
    steps: list[tuple[set[tuple[str, int]], float]], linked: set[tuple[str, int]]
) -> None:
    """Nobody is kept out who never had too many; where a robot has a link, not a moment longer."""
    door, now, full_at = Door(), 0.0, dict[str, float]()
    for strangers, passes_s in steps:
        now += passes_s
        door.look(strangers, linked, now)
        of_host = {host: sum(one[0] == host for one in strangers) for host, _ in strangers}
        full_at.update((host, now) for host, count in of_host.items() if count >= HOST_LIMIT)
        robots = {host for host, _ in linked}
        expected = {
            host
            for host, at in full_at.items()
            if at == now or (now < at + KEPT_OUT_S and host not in robots)
        }
        others = [host for host, _ in strangers if host not in expected]
        assert door.kept_out == (None if len(others) >= SHUT_LIMIT else expected)


@given(looks)
def test_strangers_are_ended_one_by_one(
    steps: list[tuple[set[tuple[str, int]], float]],
) -> None:
    """Each end costs whoever comes then 0.1 s: never two at once, and only who is there."""
    door, now, ended_at = Door(), 0.0, float("-inf")
    for strangers, passes_s in steps:
        now += passes_s / 50
        gone = door.look(strangers, (), now)
        if gone is not None:
            assert gone in strangers
            assert now - ended_at >= END_EVERY_S
            ended_at = now


def test_who_shares_a_full_hosts_address_has_a_turn_soon() -> None:
    """Half a second after, the oldest of those who say nothing is ended, long before the rest."""
    door, strangers = Door(), {("10.0.0.1", port) for port in range(HOST_LIMIT)}
    assert door.look(strangers, (), 0.0) is None
    assert door.look(strangers, (), 0.6) in strangers


def test_a_host_of_ipv6_is_its_network() -> None:
    """Who has one address of 64 bits has them all, and would else shut the door for everybody."""
    door = Door()
    strangers = {(f"2001:db8::{n:x}", 1) for n in range(SHUT_LIMIT)}
    door.look(strangers | {("2001:db8:1::1", 1)}, (), 0.0)
    assert door.kept_out == {"2001:db8::"}
    assert door.look(strangers, (), 0.6) in strangers
    door.look((), {("2001:db8::ffff", 2)}, 0.7)
    assert door.kept_out == frozenset()


@contextlib.contextmanager
def listening(address: str) -> Iterator[tuple[str, int]]:
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.create_server((address, 0), family=family) as server:
        yield server.getsockname()[:2]


def reaches(place: tuple[str, int], source: str) -> bool:
    try:
        socket.create_connection(place, 0.3, (source, 0)).close()
    except TimeoutError:
        return False
    return True


def test_only_the_hosts_named_are_dropped_and_only_while_they_are() -> None:
    """The kernel drops their first packet; what was open before goes on."""
    with listening("127.0.0.1") as place:
        door = ListenFilter(place[1])
        with socket.create_connection(place, 1.0, ("127.0.0.2", 0)) as before:
            door.drop(frozenset({"127.0.0.2", "127.0.0.3", "fe80::1%lo"}))
            assert [reaches(place, f"127.0.0.{n}") for n in (1, 2, 3)] == [True, False, False]
            assert before.send(b"x") == 1
            door.drop(None)
            assert not reaches(place, "127.0.0.1")
            door.drop(frozenset())
            assert [reaches(place, f"127.0.0.{n}") for n in (1, 2, 3)] == [True, True, True]
        door.close()


def test_hosts_of_ipv6_are_dropped_by_their_network() -> None:
    """Who has one address of a network has them all."""
    with contextlib.suppress(OSError), listening("::1") as place:
        door = ListenFilter(place[1])
        door.drop(frozenset({"2001:db8::1", "10.0.0.1"}))
        assert reaches(place, "::1")
        door.drop(frozenset({"10.0.0.1", "::ffff"}))
        assert not reaches(place, "::1")
        door.close()


def test_where_nothing_listens_nothing_is_done() -> None:
    """A replica whose port is not to be found is served as before."""
    with listening("127.0.0.1") as (_, port):
        pass
    door = ListenFilter(port)
    door.drop(None)
    door.turn_away()
    assert not door.wait(0.001)
    door.close()


@given(st.sets(st.ip_addresses().map(str), max_size=HOSTS_LIMIT))
def test_a_filter_is_short_and_jumps_only_forward_within_itself(found: set[str]) -> None:
    """The kernel takes no other; its jumps are of one byte."""
    code = instructions(found)
    assert len(code) < 256
    for at, (kind, if_true, if_not, value) in enumerate(code):
        assert max(at + 1 + if_true, at + 1 + if_not) < len(code) or kind == 0x06
        assert 0 <= value < 1 << 32
    named = {ipaddress.ip_address(one) for one in found}
    assert sum(kind == 0x06 and not value for kind, _, _, value in code) == len(named)


@pytest.mark.parametrize("count", [1, HOSTS_LIMIT, HOSTS_LIMIT + 1])
def test_more_hosts_than_fit_keep_everybody_out(count: int) -> None:
    """The filter's length is bounded: a flood of addresses shuts the door for the moment."""
    with listening("127.0.0.1") as place:
        door = ListenFilter(place[1])
        door.drop(frozenset(f"10.1.0.{n}" for n in range(count)))
        assert reaches(place, "127.0.0.1") == (count <= HOSTS_LIMIT)
        door.close()
