"""The path to a machine: transparent without faults, and as slow or dead as it is told to be."""

from __future__ import annotations

import contextlib
import hashlib
import os
import socket
import threading
import time

import pytest

from fogft.cloud.local.faults import LinkFaults
from fogft.cloud.local.relay import Relay
from tests.cloud.held import held_bytes
from tests.fakes.waiting import wait_for

SOME = 20 * 1024 * 1024


class Path:
    """A relay that runs on a thread of its own, before an echo server or whatever is given."""

    def __init__(self, begins: bytes = b"") -> None:
        self.server = socket.create_server(("127.0.0.1", 0))
        self.relay = Relay(self.server.getsockname(), begins)
        self._commands: list = []
        self._open = True
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        self._sockets: list[socket.socket] = []

    def _run(self) -> None:
        while self._open:
            while self._commands:
                self._commands.pop(0)()
            self.relay.step(0.01)
        self.relay.close()

    def set(self, *, once_held: int = 0, **faults) -> None:
        """Have its thread set the faults; at the moment at which so many bytes are held, if any."""
        done = threading.Event()

        def change() -> None:
            while held_bytes(self.relay) < once_held:
                self.relay.step(0)
            self.relay.set_faults(LinkFaults(**faults))
            done.set()

        self._commands.append(change)
        assert done.wait(30)

    def client(self, source: str = "127.0.0.1") -> socket.socket:
        host, port = self.relay.endpoint.split(":")
        made = socket.create_connection((host, int(port)), 30, (source, 0))
        self._sockets.append(made)
        return made

    def pair(self) -> tuple[socket.socket, socket.socket]:
        """Connect; return the client's end and the server's."""
        client = self.client()
        self.server.settimeout(30)
        server, _ = self.server.accept()
        server.settimeout(30)
        self._sockets.append(server)
        return client, server

    def close(self) -> None:
        self._open = False
        self._thread.join()
        for sock in (*self._sockets, self.server):
            sock.close()


@pytest.fixture
def path():
    made = Path()
    yield made
    made.close()


def receive(sock: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        chunk = sock.recv(min(1 << 20, size - len(data)))
        assert chunk, "ended early"
        data += chunk
    return data


def stuff(sock: socket.socket, for_s: float = 0.1) -> int:
    """Send until nothing was taken for a while; return how much was."""
    sock.settimeout(for_s)
    sent = 0
    with contextlib.suppress(TimeoutError):
        while sent < 1 << 30:
            sent += sock.send(bytes(1 << 20))
    assert sent < 1 << 30, "nothing stopped us"
    return sent


def silent(sock: socket.socket, for_s: float = 0.2) -> bool:
    """Whether nothing can be received for a while."""
    sock.settimeout(for_s)
    try:
        sock.recv(1)
    except TimeoutError:
        return True
    finally:
        sock.settimeout(30)
    return False


def test_bytes_pass_both_ways_unchanged(path):
    client, server = path.pair()
    data = os.urandom(SOME)
    sender = threading.Thread(target=lambda: client.sendall(data))
    sender.start()
    assert hashlib.sha256(receive(server, SOME)).digest() == hashlib.sha256(data).digest()
    sender.join()
    server.sendall(b"back")
    assert receive(client, 4) == b"back"


def test_an_end_on_one_side_leaves_the_other_direction_open(path):
    client, server = path.pair()
    client.sendall(b"last words")
    client.shutdown(socket.SHUT_WR)
    assert receive(server, 10) == b"last words"
    assert server.recv(1) == b""
    server.sendall(b"answer")
    server.close()
    assert receive(client, 6) == b"answer"
    assert client.recv(1) == b""
    wait_for(lambda: len(path.relay.connections) == 0)


def test_a_broken_connection_breaks_the_other_side(path):
    client, server = path.pair()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
    client.close()
    with pytest.raises(ConnectionResetError):
        server.recv(1)
    wait_for(lambda: len(path.relay.connections) == 0)


def test_a_reader_that_stops_stops_the_writer(path):
    """Backpressure is real: what is not taken is not received, nor kept in memory."""
    client, server = path.pair()
    sent = stuff(client, for_s=0.5)
    assert held_bytes(path.relay) <= 1 << 20
    receive(server, sent)
    client.settimeout(30)
    client.sendall(b"x")
    assert receive(server, 1) == b"x"


def test_a_stopped_reader_does_not_hinder_another_connection(path):
    stuck, _ = path.pair()
    stuff(stuck)
    client, server = path.pair()
    client.sendall(b"hello")
    assert receive(server, 5) == b"hello"


def test_a_delay_is_added_each_way_and_ends(path):
    client, server = path.pair()
    path.set(delay_s=0.2)
    begin = time.monotonic()
    client.sendall(b"a")
    assert receive(server, 1) == b"a"
    half = time.monotonic() - begin
    server.sendall(b"b")
    assert receive(client, 1) == b"b"
    assert half >= 0.2
    assert time.monotonic() - begin >= 0.4
    path.set()
    client.sendall(b"c")
    assert receive(server, 1) == b"c"


def test_a_delay_keeps_the_order_and_every_byte(path):
    client, server = path.pair()
    data = os.urandom(SOME)
    path.set(delay_s=0.05)
    sender = threading.Thread(target=lambda: client.sendall(data))
    sender.start()
    part = receive(server, SOME // 4)
    path.set(delay_s=0.001)
    part += receive(server, SOME // 4)
    path.set()
    assert part + receive(server, SOME - len(part)) == data
    sender.join()


def test_a_rate_limits_what_passes(path):
    """A chunk takes at least its size over the rate, however it is cut."""
    client, server = path.pair()
    path.set(rate_bytes_per_s=1_000_000)
    begin = time.monotonic()
    sender = threading.Thread(target=lambda: client.sendall(bytes(300_000)))
    sender.start()
    receive(server, 300_000)
    assert time.monotonic() - begin >= 0.28
    sender.join()


def test_a_slow_path_holds_little(path):
    """What a slow path cannot carry stays with the sender."""
    client, _ = path.pair()
    path.set(rate_bytes_per_s=10_000)
    stuff(client)
    assert held_bytes(path.relay) <= 128 * 1024


def test_a_blackhole_passes_nothing_and_breaks_nothing(path):
    client, server = path.pair()
    path.set(blackhole=True)
    client.sendall(b"into the dark")
    server.sendall(b"as well")
    assert silent(server)
    assert silent(client)
    path.set()
    assert receive(server, 13) == b"into the dark"
    assert receive(client, 7) == b"as well"


def test_a_blackhole_swallows_new_connections(path):
    """The kernel accepts them, as a dead host behind a live switch; nobody serves them."""
    path.set(blackhole=True)
    client = path.client()
    client.sendall(b"hello?")
    assert silent(client)
    path.set()
    path.server.settimeout(30)
    server, _ = path.server.accept()
    assert receive(server, 6) == b"hello?"
    server.close()


def test_a_blackhole_hides_that_a_side_has_gone(path):
    client, server = path.pair()
    path.set(blackhole=True)
    server.close()
    assert silent(client)
    path.set()
    assert client.recv(1) == b""


def test_a_blackhole_costs_no_processor_time(path):
    """Hang-ups that are not looked at must not wake the relay without end."""
    client, server = path.pair()
    path.set(blackhole=True)
    client.close()
    server.close()
    begin, used_s = time.monotonic(), time.process_time()
    wait_for(lambda: time.monotonic() - begin > 0.3)
    assert time.process_time() - used_s < 0.15


def test_what_a_delay_holds_back_stays_in_a_blackhole(path):
    client, server = path.pair()
    path.set(delay_s=0.1)
    client.sendall(b"late")
    path.set(blackhole=True, once_held=4)
    assert silent(server)
    path.set()
    assert receive(server, 4) == b"late"


def test_a_connection_waits_for_the_servers_first_time_only(path):
    host_port = path.server.getsockname()
    path.server.close()
    client = path.client()
    client.sendall(b"early")
    assert silent(client)
    path.server = socket.create_server(host_port)
    path.server.settimeout(30)
    server, _ = path.server.accept()
    assert receive(server, 5) == b"early"
    server.close()
    path.server.close()
    assert path.relay.reached
    with pytest.raises(ConnectionResetError):
        path.client().recv(1)


def test_a_connection_that_gives_up_while_it_waits_is_forgotten(path):
    path.server.close()
    client = path.client()
    wait_for(lambda: len(path.relay.connections) == 1)
    client.close()
    wait_for(lambda: len(path.relay.connections) == 0)


@pytest.fixture
def guarded():
    made = Path(begins=b"\x16\x03")
    yield made
    made.close()


def test_strangers_without_end_reach_no_server_and_keep_nobody_out(guarded):
    """Who says nothing, something else, or leaves: the server sees none of them; others come."""
    client = guarded.client()
    client.sendall(b"\x16\x03first")
    guarded.server.settimeout(30)
    server, _ = guarded.server.accept()
    assert receive(server, 7) == b"\x16\x03first"
    for number in range(300):
        stranger = guarded.client()
        if number % 3:
            stranger.sendall(b"GET /" if number % 3 == 1 else b"\x16\x03hello")
            if number % 3 == 2:
                stranger.close()
    late = guarded.client("127.0.0.66")
    late.sendall(b"\x16\x03late")
    while True:
        taken, (host, _) = guarded.server.accept()
        if host == "127.0.0.66":
            break
        taken.close()  # it had left a moment too late
    assert receive(taken, 6) == b"\x16\x03late"
    taken.close()
    server.sendall(b"back")
    assert receive(client, 4) == b"back"
    wait_for(lambda: len(guarded.relay.connections) <= 40)
    server.close()
