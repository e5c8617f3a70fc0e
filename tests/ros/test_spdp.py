"""A participant that has just joined need not wait until those that run announce themselves."""

from __future__ import annotations

import socket
import struct
import threading

import pytest

from fogft.ros import spdp
from fogft.ros.joining import Pauses

PREFIX = slice(8, 20)  # of a message's sender, in its header
LIMIT_S = 20.0


def listening(domain: int, id: int) -> socket.socket:
    """Return a socket where a domain's participant of this number hears of others."""
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.bind(("127.0.0.1", 7400 + 250 * domain + 10 + 2 * id))
    made.settimeout(LIMIT_S)
    return made


def test_what_others_answer_an_introduction_reaches_this_process(ros_domain: int) -> None:
    """The one introduced is one that nobody has seen, is answered at its port, and takes leave."""
    with listening(ros_domain, 60) as other, listening(ros_domain, 61) as ours:
        introduction = spdp.Introduction(ros_domain)
        told = other.recv(1 << 16)
        prefix = told[PREFIX]
        assert spdp.is_known(prefix)
        assert told == ours.recv(1 << 16)
        place = struct.pack("<HHi", 0x32, 24, 1)
        (port,) = struct.unpack_from("<I", told, told.index(place) + len(place))
        other.sendto(b"RTPS I am here, " + prefix, ("127.0.0.1", port))
        assert ours.recv(1 << 16) == b"RTPS I am here, " + bytes(spdp.PREFIX_BYTES)
        assert spdp.gone(prefix) in iter(lambda: other.recv(1 << 16), b"")
        introduction.close()


def test_a_killed_participant_is_declared_gone_once_it_is_known(ros_domain: int) -> None:
    """An id of another middleware, or a damaged one, is not told."""
    known = b"\x01\x0f" + bytes(range(10))
    with listening(ros_domain, 60) as other:
        for prefix in (known[:-1], b"\x07" + known[1:], known):
            spdp.declare_gone(prefix, ros_domain)
        assert other.recv(1 << 16) == spdp.gone(known), "nothing came before it"


def test_a_peer_whose_name_nobody_knows_holds_up_nothing(
    ros_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a network a look-up takes seconds, and a takeover must not wait for it."""
    begun, over = threading.Event(), threading.Event()

    def look_up(host: str) -> str:
        if host == "127.0.0.1":
            return host
        begun.set()
        assert over.wait(LIMIT_S)
        raise OSError(host)

    monkeypatch.setattr(socket, "gethostbyname", look_up)
    monkeypatch.setenv("ROS_STATIC_PEERS", "robot;other")
    known = b"\x01\x0f" + bytes(range(10))
    with listening(ros_domain, 60) as other:
        spdp.declare_gone(known, ros_domain)
        assert other.recv(1 << 16) == spdp.gone(known)
        assert begun.wait(LIMIT_S)
    over.set()


def test_the_highest_domain_has_fewer_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[int] = []
    monkeypatch.setattr(socket.socket, "sendto", lambda _, message, place: told.append(place[1]))
    spdp.declare_gone(b"\x01\x0f" + bytes(range(10)), 232)
    assert max(told) == 65534


def test_a_port_that_a_firewall_bars_bars_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[int] = []

    def send(_: socket.socket, message: bytes, place: tuple[str, int]) -> None:
        told.append(place[1])
        raise PermissionError

    monkeypatch.setattr(socket.socket, "sendto", send)
    spdp.declare_gone(b"\x01\x0f" + bytes(range(10)), 0)
    assert {7410, 7412, 7536} <= set(told)


def test_a_stop_that_dds_does_not_outlast_is_noticed_once() -> None:
    """Fast DDS gives up on a participant 20 s after the last sign of life, sent every 3 s."""
    now = [100.0]
    pauses = Pauses(lambda: now[0])

    def looked_after(seconds: float) -> bool:
        now[0] += seconds
        return pauses.was_long()

    assert [looked_after(seconds) for seconds in (0.2, 14.0, 17.0, 0.2)] == [
        False,
        False,
        True,
        False,
    ]
