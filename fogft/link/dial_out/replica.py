"""The replica's side of dial-out: keep two idle connections at each robot's dial-in port.

When the robot uses one, it is joined with this replica's own listener, and a new one replaces it.
Not here: the dial-in port, or door (`robot`), the listener (`listener`).
"""

import logging
import socket
import threading
import time
from collections.abc import Iterable
from ipaddress import IPv4Address
from zlib import crc32

from fogft import poll
from fogft.errors import FogftError
from fogft.link.dial_out import tunnel
from fogft.link.dial_out.robot import GO, PURPOSE, SIGN, SIGN_EVERY_S, SILENCE_S
from fogft.model.names import host_and_port
from fogft.process import on_thread
from fogft.records import frames
from fogft.records.record import Sign

log = logging.getLogger(__name__)

WAITING = 2
TARGETS_LIMIT = 64
_BACKOFF_S = 0.3
_CONNECT_TIMEOUT_S = 1.5


class DialOut:
    """Connects robots' dial-in ports with our listener, `local` (``host:port``)."""

    def __init__(self, local: str, pool_uid: str, sign: Sign) -> None:
        host, port = host_and_port(local)
        self._local = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host), port
        self._pool_uid = pool_uid
        self._sign = sign
        self._lock = threading.Lock()
        self._targets: dict[str, threading.Event] = {}  # set once the door is no longer followed
        self._details: dict[str, str] = {}  # each door's problem, empty while connected
        self._tunnels = tunnel.Tunnels()

    def follow(self, doors: Iterable[str]) -> None:
        """Connect to these dial-in ports (``host:port``) and no others; connections in use stay."""
        wanted = list(dict.fromkeys(doors))[:TARGETS_LIMIT]
        with self._lock:
            for door in [d for d in self._targets if d not in wanted]:
                self._targets.pop(door).set()
                self._details.pop(door, None)
            new = [door for door in wanted if door not in self._targets]
            for door in new:
                self._targets[door] = threading.Event()
        for door in new:
            for number in range(WAITING):
                stop, name = self._targets[door], f"fogft-dial-out-{number}"
                on_thread(self._keep_waiting, door, stop, name=name)

    def close(self) -> None:
        """Close all connections. Repeatable."""
        self.follow(())
        self._tunnels.close()

    def _keep_waiting(self, door: str, stop: threading.Event) -> None:
        while not stop.is_set():
            link: socket.socket | None = None
            try:
                link = socket.create_connection(host_and_port(door), _CONNECT_TIMEOUT_S)
                self._greet(link)
                self._say(door, "")
                if self._wait(link, stop):
                    # A source address per door: the listener limits connections by host.
                    ours = IPv4Address(0x7F000002 + crc32(door.encode()) % 0xFFFFFC)
                    source = (str(ours) if self._local[0] == "127.0.0.1" else "", 0)
                    own = socket.create_connection(self._local, _CONNECT_TIMEOUT_S, source)
                    self._tunnels.carry(link, own)
                    link = None
                    continue  # without a pause: open its replacement
            except (OSError, EOFError, ValueError, FogftError) as error:
                self._say(door, str(error) or type(error).__name__)
            finally:
                if link is not None:
                    tunnel.hang_up(link)
            stop.wait(_BACKOFF_S)

    def _greet(self, link: socket.socket) -> None:
        """Authenticate to the door."""
        tunnel.keep_alive(link)
        nonce, _ = frames.read_challenge(tunnel.receive(link, 4 << 10))
        link.settimeout(tunnel.GREETING_TIMEOUT_S)
        proof = frames.proof_bytes(PURPOSE, nonce, self._pool_uid.encode())
        link.sendall(frames.greeting(*self._sign(proof)))

    def _wait(self, link: socket.socket, stop: threading.Event) -> bool:
        """Wait until the robot uses the connection; return False once `stop` is set."""
        heard_at = time.monotonic()
        while not stop.is_set():
            if poll.is_ready(link, SIGN_EVERY_S):
                data = link.recv(1)
                if data == GO:
                    link.sendall(GO)
                    return True
                if data != SIGN:
                    raise EOFError("the robot closed the connection")
                heard_at = time.monotonic()
                link.sendall(SIGN)
            elif time.monotonic() - heard_at > SILENCE_S:
                raise TimeoutError("the robot is silent")
        return False

    def _say(self, door: str, detail: str) -> None:
        with self._lock:
            if door not in self._targets or self._details.get(door) == detail:
                return
            self._details[door] = detail
        log.info("door_%s door=%s reason=%r", "shut" if detail else "reached", door, detail)
