"""Rendezvous as processes, and clients that speak for members of a pool."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fogft.model.credentials import CredentialPaths
from fogft.model.plain import to_plain
from fogft.model.replica import Member, Membership, ReplicaId
from fogft.pool.credentials.authority import Role
from fogft.records.client import RendezvousClient
from fogft.records.record import RecordKind
from fogft.records.roster import SlotState, admission, admission_content, located
from tests.link import forked
from tests.link.wire_pool import POOL_UID, Authority, wait_for
from tests.ports import free_port
from tests.records import certificate_names

ROOT = Path(__file__).parents[2]


class Rendezvous:
    """A `fogft rendezvous` process, which can be killed and started again."""

    def __init__(
        self, authority: Authority, name: str, *, files: CredentialPaths | None = None,
        endpoint: str = "", prefix: Sequence[str] = (),
    ) -> None:  # fmt: skip
        common_name = certificate_names.rendezvous(POOL_UID, name)
        files = files or authority.issue(common_name, Role.RENDEZVOUS)
        self.folder = authority.folder / f"rendezvous-{name}"
        self.folder.mkdir(exist_ok=True)
        self.endpoint = endpoint or f"127.0.0.1:{free_port()}"
        self._prefix = list(prefix)
        self._status = self.folder / "status.json"
        self.config = self.folder / "rendezvous.yaml"
        self.config.write_text(
            f'pool_uid: "{POOL_UID}"\nlisten: {self.endpoint}\nstatus: status.json\n'
            f"credentials: {{ca: {files.ca}, certificate: {files.certificate}, key: {files.key}}}\n"
        )
        self.process: forked.Forked | subprocess.Popen[str] | subprocess.Popen[bytes] | None = None
        self.start()

    def start(self) -> None:
        self._status.unlink(missing_ok=True)
        words = ("rendezvous", "--config", str(self.config))
        with (self.folder / "log").open("ab") as log:
            if self._prefix:
                self.process = subprocess.Popen(
                    [*self._prefix, sys.executable, "-m", "fogft", *words],
                    cwd=ROOT, stdout=log, stderr=log,
                )  # fmt: skip
            else:
                self.process = forked.start("tests.records.part", *words, stderr=log.fileno())
        wait_for(self._status.exists, 120.0)

    def forget(self) -> None:
        (self.folder / "records.json").unlink(missing_ok=True)

    def signal(self, number: int) -> None:
        assert self.process is not None
        self.process.send_signal(number)

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None

    def alive(self) -> bool:
        return self.process is not None and self.process.poll() is None

    def status(self) -> dict[str, Any]:
        return dict(json.loads(self._status.read_text()))

    def count(self, section: str, event: str) -> int:
        return int(self.status()[section].get(event, 0))


class Party:
    """A member of the pool that knows records."""

    def __init__(
        self, files: CredentialPaths, *endpoints: str, cache: Path | None = None, start: bool = True
    ) -> None:
        self.changed = threading.Event()
        self.client = RendezvousClient(
            endpoints, files, POOL_UID, cache=cache, changed=self.changed.set
        )
        if start:
            self.client.start()

    def membership(self) -> Membership | None:
        known = self.client.known
        found = known.of(RecordKind.ADMISSION)
        return located(admission(found[0]), known.of(RecordKind.SLOT)) if found else None

    def endpoint(self, slot: int) -> str | None:
        membership = self.membership()
        for member in membership.members if membership else ():
            if member.id.slot == slot:
                return member.endpoint
        return None

    def admit(self, version: int, *members: tuple[int, int], epoch: int = 1) -> None:
        """Speak as the manager: let these (slot, generation) in."""
        admitted = tuple(Member(ReplicaId(POOL_UID, *m), "") for m in members)
        content = admission_content(Membership("p", POOL_UID, epoch, version, admitted))
        self.client.publish(RecordKind.ADMISSION, "", epoch, content, sequence=version)

    def announce(self, slot: int, generation: int, endpoint: str) -> None:
        """Speak as a replica: say where it is."""
        content = to_plain(SlotState(endpoint=endpoint))
        self.client.publish(RecordKind.SLOT, str(slot), generation, content)

    def orders(self) -> dict[tuple[str, str], tuple[int, int]]:
        return {record.key: record.order for record in self.client.known.records}


def manager_files(authority: Authority) -> CredentialPaths:
    return authority.issue(certificate_names.manager(POOL_UID), Role.MANAGER)
