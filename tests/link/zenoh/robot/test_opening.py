"""How long a link's tries to open a connection may take, and what is said of those that fail."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from fogft.link.zenoh import diagnosis
from fogft.link.zenoh.diagnosis import Opening
from fogft.link.zenoh.robot import attempts
from fogft.link.zenoh.robot.link import ZenohLink
from fogft.link.zenoh.settings import LinkSettings
from fogft.model.credentials import CredentialPaths
from tests.link.namespaces import Namespaces, inside
from tests.link.wire_pool import Authority, ReplicaProcess, peer, wait_for

SETTINGS = LinkSettings(open_timeout_s=1.0, long_open_timeout_s=4.0)
CREDENTIALS = CredentialPaths(Path("ca"), Path("crt"), Path("key"))


def test_a_connection_that_gets_no_thread_to_send_leaves_nothing_open(
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Else the replica would take this robot for one that opens connections without end."""
    replica, open_files = start_replica(), list[int]()

    def none(*_: object, **__: object) -> None:
        open_files.append(len(os.listdir("/proc/self/fd")))
        raise OSError("can't start new thread")

    with monkeypatch.context() as full:
        full.setattr(attempts, "on_thread", none)
        link = dial(replica.endpoint)
        wait_for(lambda: len(open_files) >= 8)
    wait_for(lambda: link.usable)
    assert max(open_files) <= open_files[0] + 3
    assert replica.count("surplus_links") == 0


def test_every_third_time_out_in_a_row_is_a_long_one() -> None:
    opening = Opening(peer("10.0.0.1:1"), SETTINGS)
    allowed = []
    for _ in range(7):
        allowed.append(opening.timeout_s)
        assert "does not answer" in opening.failed(opening.timeout_s, 0.0, CREDENTIALS)
    assert allowed == [1.0, 1.0, 4.0, 1.0, 1.0, 4.0, 1.0]


def test_a_try_that_is_well_or_refused_at_once_begins_the_count_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(diagnosis, "explain", lambda *_: "refused")
    opening = Opening(peer("10.0.0.1:1"), SETTINGS)
    for end in (opening.done, lambda: opening.failed(0.01, 0.0, CREDENTIALS)):
        for _ in range(2):
            opening.failed(1.0, 0.0, CREDENTIALS)
        end()
        assert opening.timeout_s == 1.0


def test_words_are_looked_for_once_in_five_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnosis, "explain", lambda *_: "refused")
    opening = Opening(peer("10.0.0.1:1"), SETTINGS)
    said = [opening.failed(0.01, now, CREDENTIALS) for now in (0.0, 1.0, 4.9, 5.0, 6.0)]
    assert said == ["refused", "", "", "refused", ""]


def test_a_replica_that_was_never_reached_is_not_called_frozen() -> None:
    """A machine that still starts answers nobody: that says nothing of what is wrong with it."""
    opening = Opening(peer("10.0.0.1:1"), SETTINGS)
    assert opening.failed(1.0, 0.0, CREDENTIALS) == "`10.0.0.1:1` does not answer yet"
    opening.done()
    said = opening.failed(1.0, 0.0, CREDENTIALS)
    assert said == "`10.0.0.1:1` no longer answers: frozen, cut off or overloaded"


def test_an_interface_that_is_not_there_is_named() -> None:
    opening = Opening(replace(peer("10.0.0.1:1"), interface="no-such"), SETTINGS)
    assert "`no-such`" in opening.failed(0.01, 0.0, CREDENTIALS)


def answering(said: bytes, host: str = "0.0.0.0") -> socket.socket:
    """Listen, say this to whoever has spoken, and hang up."""
    port = socket.create_server((host, 0))

    def serve() -> None:
        with contextlib.suppress(OSError):
            while True:
                link, _ = port.accept()
                with link:
                    link.recv(4096)
                    link.sendall(said)

    threading.Thread(target=serve, daemon=True).start()
    return port


@pytest.mark.parametrize(
    ("said", "words"), [(b"HTTP/1.1 302 Found\r\n\r\n", "login page"), (b"", "closed before TLS")]
)
def test_what_speaks_no_tls_is_not_called_by_an_error_of_openssl(
    tmp_path: Path, said: bytes, words: str
) -> None:
    """The login page of a hotel's network, or a proxy, answers for every address."""
    with answering(said) as port:
        at = peer(f"127.0.0.1:{port.getsockname()[1]}")
        assert words in diagnosis.explain(at, Authority(tmp_path).robot())


def test_the_reason_is_looked_for_at_each_address_of_a_host(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with answering(b"no TLS", "127.0.0.1") as port:
        number = port.getsockname()[1]
        found = [
            (socket.AF_INET, socket.SOCK_STREAM, 6, "", (host, number))
            for host in ("127.0.0.2", "127.0.0.1")
        ]
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
        at, files = peer(f"lab.test:{number}"), Authority(tmp_path).robot()
        assert "TLS" in diagnosis.explain(at, files)
        found.pop()
        assert "connection refused" in diagnosis.explain(at, files)


def test_the_reason_is_looked_for_through_the_links_own_interface(
    tmp_path: Path, net: Namespaces
) -> None:
    """Another uplink reaches the replica; that says nothing of this one."""
    robot, replica = net.add("r"), net.add("p")
    near, _ = net.join(robot, "10.79.1.1", replica, "10.79.1.2")
    other, _ = net.join(robot, "10.79.2.1", replica, "10.79.2.2")
    with inside(replica):
        port = answering(b"no TLS")
    net.blackhole(replica, "10.79.1.1")
    with port, inside(robot):
        at, files = peer(f"10.79.2.2:{port.getsockname()[1]}"), Authority(tmp_path).robot()
        assert "TLS" in diagnosis.explain(replace(at, interface=other), files)
        assert "does not answer" in diagnosis.explain(replace(at, interface=near), files)
