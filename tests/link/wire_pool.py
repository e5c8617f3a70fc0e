"""What the wire tests share: a small pool of certificates, replicas as processes, a link owner."""

from __future__ import annotations

import json
import resource
import signal
import threading
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import zenoh

from fogft.link.port import Answer, Link, Peer
from fogft.link.zenoh.settings import SESSIONS_LIMIT, LinkSettings
from fogft.model import names
from fogft.model.credentials import CredentialPaths
from fogft.model.refusal import Refusal
from fogft.model.replica import LinkState, ReplicaId
from fogft.pool.credentials import authority
from fogft.pool.credentials.authority import Role
from tests.fakes.waiting import wait_for
from tests.link import forked
from tests.link.freezing import freeze
from tests.records import certificate_names

POOL_UID = "0123456789abcdef"
SERVICE, TYPE = "/echo", "plain_msgs/srv/Echo"  # not installed: its bytes are anything
LIMIT_S = 30.0  # generous: a test that passes never waits for it


class Authority:
    """A pool's CA in a folder, and what it issued; `ca` is where, if not in the same."""

    def __init__(self, folder: Path, *, ca: Path | None = None) -> None:
        self.folder = folder
        self._ca = ca or folder / "ca"
        folder.mkdir(exist_ok=True)
        authority.create_authority(self._ca, POOL_UID)

    def issue(self, common_name: str, role: Role, *, days: float = 365.0) -> CredentialPaths:
        stem = f"{common_name}-{role.value}"
        credential = authority.issue(self._ca, common_name, role=role, days=days)
        authority.write(credential, self.folder, stem)
        return CredentialPaths(
            self.folder / "ca.crt", self.folder / f"{stem}.crt", self.folder / f"{stem}.key"
        )

    def robot(self, name: str = "robot", generation: int = 1) -> CredentialPaths:
        name = certificate_names.robot(POOL_UID, name, generation)
        return self.issue(name, Role.ROBOT)

    def replica(self, slot: int = 0, generation: int = 1) -> CredentialPaths:
        id = ReplicaId(POOL_UID, slot, generation)
        return self.issue(id.certificate_name, Role.REPLICA)


def keys(slot: int) -> dict[str, str]:
    return {SERVICE: names.service_key(POOL_UID, slot, SERVICE, TYPE)}


def peer(endpoint: str, slot: int = 0, generation: int = 1) -> Peer:
    id = ReplicaId(POOL_UID, slot, generation)
    return Peer(id, endpoint, id.certificate_name)


def hears(session: zenoh.Session, key: str) -> None:
    """Wait until a session knows that the replica hears what is published at a key."""
    publisher = session.declare_publisher(key)
    wait_for(lambda: publisher.matching_status.matching)  # type: ignore[attr-defined]
    publisher.undeclare()  # type: ignore[no-untyped-call]


def knows(session: zenoh.Session, slot: int, pool_uid: str = POOL_UID) -> None:
    """Wait until a session knows all that a replica or gateway hears; what it declares last."""
    querier = session.declare_querier(names.slot_key(pool_uid, slot, names.PROBE))
    wait_for(lambda: querier.matching_status.matching)  # type: ignore[attr-defined]
    querier.undeclare()  # type: ignore[no-untyped-call]
    hears(session, names.slot_key(pool_uid, slot, names.CANCEL))


def request_id(number: int) -> bytes:
    return number.to_bytes(16, "big")


class Owner:
    """Takes what links tell, and remembers it."""

    def __init__(self) -> None:
        self.answers: list[tuple[int, Answer]] = []
        self.states: list[tuple[int, LinkState]] = []
        self.changes = 0
        self.too_late: list[tuple[str, bytes]] = []  # forgotten, and worked on
        self.dropped: list[tuple[str, bytes]] = []  # forgotten, and not worked on
        self._lock = threading.Lock()

    def answered(self, link: Link, answer: Answer) -> None:
        with self._lock:
            self.answers.append((link.peer.id.slot, answer))

    def late(self, link: Link, answer: Answer) -> None:
        with self._lock:
            worked = answer.payload is not None or answer.refusal is Refusal.LATE
            (self.too_late if worked else self.dropped).append((answer.service, answer.request_id))

    def changed(self, link: Link) -> None:
        with self._lock:
            self.changes += 1
            self.states.append((link.peer.id.slot, link.status().state))

    def of(self, number: int) -> list[Answer]:
        return [a for _, a in list(self.answers) if a.request_id == request_id(number)]

    def from_slot(self, slot: int) -> list[Answer]:
        return [a for s, a in list(self.answers) if s == slot]


class ReplicaProcess:
    """A listener in a process of its own; see `replica_process.py` for what it answers."""

    def __init__(
        self,
        files: CredentialPaths,
        *,
        endpoint: str = "127.0.0.1:0",
        slot: int = 0,
        generation: int = 1,
        claims: Sequence[int] | None = None,
        delay_s: float = 0.0,
        reply_bytes: int = -1,
        settings: LinkSettings | None = None,
        sessions: int = SESSIONS_LIMIT,
        records: Path | None = None,
    ) -> None:
        """Start one.

        Args:
            claims: Slot and generation that it says it is, where that is a lie.
            sessions: How many it has room for.
            records: What it was launched with of what the pool has signed.
        """
        arguments = {
            "endpoint": endpoint,
            "ca": str(files.ca),
            "certificate": str(files.certificate),
            "key": str(files.key),
            "slot": slot,
            "generation": generation,
            "claims": list(claims or (slot, generation)),
            "delay_s": delay_s,
            "reply_bytes": reply_bytes,
            "settings": asdict(settings or LinkSettings()),
            "sessions": sessions,
            "records": str(records or ""),
        }
        self._process = forked.start("tests.link.zenoh.replica_process", json.dumps(arguments))
        self.endpoint = str(self._read()["endpoint"])

    def _read(self) -> dict[str, object]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        assert line, "the replica's process has ended"
        return dict(json.loads(line))

    def stop(self) -> None:
        """Have it close its listener and end. Does not wait for that."""
        assert self._process.stdin is not None
        self._process.stdin.close()

    def ask(self, **command: object) -> dict[str, object]:
        """Send a command: `ready`, `draining`, `delay_s`, `revoke`, or `watch` (a file for notices,
        and where to write that one was read); none asks for its counters.
        """
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(command) + "\n")
        self._process.stdin.flush()
        return self._read()

    def descriptors(self) -> int:
        """Return how many files and sockets it has open."""
        return len(list(Path(f"/proc/{self._process.pid}/fd").iterdir()))

    def allow_descriptors(self, more: int) -> None:
        """Let it open so many more than it has now, and none beyond."""
        _, hard = resource.prlimit(self._process.pid, resource.RLIMIT_NOFILE)
        limits = self.descriptors() + more, hard
        resource.prlimit(self._process.pid, resource.RLIMIT_NOFILE, limits)

    def count(self, event: str) -> int:
        return int(self.ask().get(event, 0))  # type: ignore[call-overload]

    def signal(self, number: int) -> None:
        if number == signal.SIGSTOP:
            freeze(self._process.pid)
        else:
            self._process.send_signal(number)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()
