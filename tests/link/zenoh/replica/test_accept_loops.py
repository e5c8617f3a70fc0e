"""Zenoh's accept loops at one port: what strangers cost one of them delays nobody at the next."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator

import pytest
import zenoh

from fogft.link.zenoh import settings
from fogft.link.zenoh.replica.accept_loops import RESTS_AFTER_S, AcceptLoops
from fogft.link.zenoh.settings import LinkSettings
from fogft.model.credentials import CredentialPaths
from fogft.model.replica import ReplicaId
from tests.hostile.robot import session_at, target
from tests.link.wire_pool import POOL_UID, Authority, wait_for

STRANGERS = 60  # they cost Zenoh six seconds


@contextlib.contextmanager
def loops_at(files: CredentialPaths, host: str) -> Iterator[tuple[AcceptLoops, tuple[str, int]]]:
    """The loops of a session that listens as a replica's does, and where."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, 0), family=family) as free:
        port = free.getsockname()[1]
    listen = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    config = settings.replica_settings(listen, ReplicaId(POOL_UID, 0, 1), files, LinkSettings())
    session = zenoh.open(settings.to_zenoh(config))
    loops = AcceptLoops(port)
    try:
        yield loops, ("127.0.0.1", port)
    finally:
        loops.close()
        session.close()


def joins(place: tuple[str, int], robot: CredentialPaths) -> None:
    """Have a robot open a session, however often it has to try."""
    at = target(f"{place[0]}:{place[1]}")

    def opens() -> bool:
        with contextlib.suppress(zenoh.ZError), session_at(at, robot):
            return True
        return False

    wait_for(opens)


def ended(stranger: socket.socket) -> bool:
    stranger.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        return bool(stranger.recv(1)) or True
    return False


@pytest.mark.parametrize("host", ["127.0.0.1", "::"])
def test_who_comes_after_strangers_does_not_wait_for_their_ends(
    authority: Authority, host: str
) -> None:
    """Sixty are let in and fail at once: the loop rests after each, and the next takes over."""
    files, robot = authority.replica(0), authority.robot()
    with contextlib.ExitStack() as stack:
        loops, place = stack.enter_context(loops_at(files, host))
        strangers = [
            stack.enter_context(socket.create_connection(place, 5.0)) for _ in range(STRANGERS)
        ]
        for one in strangers:
            one.sendall(b"no TLS" * 40)
        wait_for(lambda: any(ended(one) for one in strangers))
        waits = stack.enter_context(socket.create_connection(place, 5.0))
        loops.look(0.0)
        loops.look(2 * RESTS_AFTER_S)
        with pytest.raises(ConnectionResetError):  # he may come again at once
            waits.recv(1)
        joins(place, robot)
        assert not all(ended(one) for one in strangers)


def test_a_loop_that_takes_what_comes_is_left_where_it_is(authority: Authority) -> None:
    """Nobody is turned away who has waited for less than a rest."""
    with loops_at(authority.replica(0), "127.0.0.1") as (loops, place):
        for now in range(5):
            loops.look(float(now))
            joins(place, authority.robot())


def test_a_port_of_nothing_but_one_socket_is_served_by_it() -> None:
    """Where Zenoh is not what listens, or its sockets cannot be moved, all is as without."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        loops = AcceptLoops(server.getsockname()[1])
        with socket.create_connection(server.getsockname()):
            assert loops.wait(5.0)
            loops.look(0.0)
            loops.look(1.0)
            assert server.accept()
        loops.close()
