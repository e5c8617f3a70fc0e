"""New credentials are taken into use while requests flow, and old ones are shut out."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from fogft.link.zenoh.robot.dialer import ZenohDialer
from fogft.link.zenoh.robot.link import ZenohLink
from fogft.model.credentials import CredentialPaths
from fogft.model.proxy_config import ClientProxyConfig
from fogft.model.replica import LinkState
from fogft.pool.credentials.authority import Role
from fogft.proxy.robot.following import Following
from fogft.records.record import Record, RecordKind, SignedRecord, sign_record
from fogft.records.signing import Signer
from tests.link.wire_pool import (
    POOL_UID,
    SERVICE,
    Authority,
    Owner,
    ReplicaProcess,
    keys,
    peer,
    request_id,
    wait_for,
)
from tests.records import certificate_names


@pytest.fixture
def files(authority: Authority, tmp_path: Path) -> CredentialPaths:
    """A robot's files, which its first generation is in."""
    files = CredentialPaths(tmp_path / "ca.crt", tmp_path / "robot.crt", tmp_path / "robot.key")
    _replace(files, authority.robot("ada"))
    return files


def _replace(files: CredentialPaths, by: CredentialPaths) -> None:
    for path, new in ((files.ca, by.ca), (files.key, by.key), (files.certificate, by.certificate)):
        path.with_suffix(".new").write_bytes(new.read_bytes())
        path.with_suffix(".new").replace(path)


class Caller(threading.Thread):
    """Offers requests without a pause until told to stop, 20 at a time at most."""

    def __init__(self, link: ZenohLink, owner: Owner) -> None:
        super().__init__(daemon=True)
        self._link, self._owner = link, owner
        self.offered = 0
        self.enough = threading.Event()

    def run(self) -> None:
        while not self.enough.wait(0.001):
            if self.offered - len(self._owner.answers) < 20:
                payload = self.offered.to_bytes(4, "big")
                self.offered += self._link.offer(SERVICE, request_id(self.offered), payload, 20.0)


def _revoke(replica: ReplicaProcess, generation: int) -> None:
    replica.ask(revoke=[certificate_names.robot(POOL_UID, "ada", generation)])


@pytest.mark.parametrize("delay_s", [0.0, 0.2])
def test_rotating_a_robots_credentials_loses_no_request(
    authority: Authority,
    files: CredentialPaths,
    owner: Owner,
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    delay_s: float,
) -> None:
    """Three times over, with requests under way: each is answered once, and none is sent again."""
    replica = start_replica(delay_s=delay_s)
    link = dial(replica.endpoint, robot="ada", files=files)
    wait_for(lambda: link.usable)
    caller = Caller(link, owner)
    caller.start()
    for generation in (2, 3, 4):
        before = len(owner.answers)
        wait_for(lambda before=before: len(owner.answers) > before + 30)  # type: ignore[misc]
        _replace(files, authority.robot("ada", generation))
        link.renew()
        wait_for(lambda generation=generation: link.status().reopened == generation - 1)  # type: ignore[misc]
    last = len(owner.answers)
    wait_for(lambda: len(owner.answers) > last + 30)
    caller.enough.set()
    caller.join()
    wait_for(lambda: len(owner.answers) == caller.offered)
    assert [a.refusal for _, a in owner.answers if a.refusal] == []
    assert {a.payload for _, a in owner.answers} == {
        n.to_bytes(4, "big") for n in range(caller.offered)
    }
    assert replica.count("requests") == caller.offered
    _revoke(replica, 1), _revoke(replica, 2), _revoke(replica, 3)
    assert link.offer(SERVICE, request_id(1 << 30), b"the fourth is good", 20.0)
    wait_for(lambda: owner.of(1 << 30))
    assert owner.of(1 << 30)[0].payload == b"the fourth is good"


def test_new_credentials_that_are_no_good_leave_the_old_link(
    authority: Authority,
    files: CredentialPaths,
    owner: Owner,
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    tmp_path: Path,
) -> None:
    """A certificate of another CA: the link stays up with what it has, and says what is wrong."""
    replica = start_replica()
    link = dial(replica.endpoint, robot="ada", files=files)
    wait_for(lambda: link.usable)
    theirs = Authority(tmp_path / "stranger").robot("ada", 2)
    _replace(files, CredentialPaths(files.ca, theirs.certificate, theirs.key))
    link.renew()
    wait_for(lambda: "from a different CA" in link.status().detail)
    assert link.status().state is LinkState.UP
    assert link.offer(SERVICE, request_id(1), b"x", 20.0)
    wait_for(lambda: owner.of(1))
    assert owner.of(1)[0].payload == b"x"


def test_a_revoked_robot_is_shut_out_and_told_why_while_another_goes_on(
    authority: Authority,
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    owner: Owner,
) -> None:
    """What it asks is refused at once, and its link ends with the next probe."""
    replica = start_replica()
    eve, ada = dial(replica.endpoint, robot="eve"), dial(replica.endpoint, robot="ada")
    wait_for(lambda: eve.usable and ada.usable)
    replica.ask(revoke=[certificate_names.robot(POOL_UID, "eve")])
    eve.offer(SERVICE, request_id(1), b"x", 20.0)
    wait_for(lambda: owner.of(1) and not eve.usable)
    assert owner.of(1)[0].payload is None
    wait_for(lambda: eve.status().detail == "our certificate is revoked")
    before = replica.count("not_admitted")
    wait_for(lambda: replica.count("not_admitted") > before)  # it tries again, in vain
    assert not eve.usable
    assert ada.usable
    assert ada.status().reopened == 0
    assert ada.offer(SERVICE, request_id(2), b"y", 20.0)
    wait_for(lambda: owner.of(2))
    assert owner.of(2)[0].payload == b"y"


def _revocation(files: CredentialPaths, name: str) -> SignedRecord:
    content = {"names": [name]}
    record = Record(POOL_UID, RecordKind.REVOCATION, "", 1, 1, content)
    return sign_record(record, Signer(files.certificate, files.key))


def test_a_robot_passes_the_managers_revocation_on_and_no_other(
    authority: Authority,
    start_replica: Callable[..., ReplicaProcess],
    dial: Callable[..., ZenohLink],
    owner: Owner,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A record that a robot or a replica signed revokes nobody, whoever brings it."""
    monkeypatch.setattr("fogft.link.zenoh.robot.link._TELL_AGAIN_S", 3600.0)
    replica = start_replica()
    eve = dial(replica.endpoint, robot="eve")
    dialer = ZenohDialer(authority.robot("ada"), robot="ada", pool_uid=POOL_UID)
    try:
        ada = dialer.dial(peer(replica.endpoint), keys(0), owner)
        wait_for(lambda: ada.usable and eve.usable)
        bad = certificate_names.robot(POOL_UID, "eve")
        for number, signer in enumerate((authority.robot("mallory"), authority.replica(1)), 1):
            dialer.tell([_revocation(signer, bad)])
            wait_for(lambda number=number: replica.count("records_refused") == number)  # type: ignore[misc]
        assert replica.count("not_admitted") == 0
        manager = authority.issue(certificate_names.manager(POOL_UID), Role.MANAGER)
        dialer.tell([_revocation(manager, bad)])
        wait_for(lambda: eve.status().detail == "our certificate is revoked")
        assert ada.usable
        assert ada.status().reopened == 0
        told = replica.count("records")
        wait_for(lambda: replica.count("probes") > 20)
        assert replica.count("records") == told, "what was taken is not told again"
    finally:
        dialer.close()


def _lease(files: CredentialPaths, epoch: int) -> SignedRecord:
    record = Record(POOL_UID, RecordKind.LEASE, "", epoch, 1, {"at": 1e9, "lasts_s": 60.0})
    return sign_record(record, Signer(files.certificate, files.key))


def test_a_robot_hears_of_a_later_manager_from_replicas_and_of_none_that_they_make_up(
    authority: Authority, start_replica: Callable[..., ReplicaProcess], tmp_path: Path
) -> None:
    """A replica answers an older lease with the newer one, whose signature counts."""
    replica = start_replica()
    manager = authority.issue(certificate_names.manager(POOL_UID), Role.MANAGER)
    ada = authority.robot("ada")
    config = ClientProxyConfig(
        pool="p", pool_uid=POOL_UID, credentials=ada, services=(), robot="ada",
        membership=tmp_path / "a", status=tmp_path / "b", lock=tmp_path / "c",
    )  # fmt: skip
    following = Following(config)
    dialers = [ZenohDialer(ada, robot="ada", pool_uid=POOL_UID) for _ in range(2)]
    try:
        for dialer, epoch in zip(dialers, (2, 1), strict=True):
            dialer.tell([_lease(manager, epoch)])
            dialer.dial(peer(replica.endpoint), keys(0), Owner())
            wait_for(lambda epoch=epoch: replica.count("records") >= 3 - epoch)  # type: ignore[misc]
        heard: list[SignedRecord] = []
        wait_for(lambda: heard.extend(dialers[1].newer()) or heard)
        assert following.report(dialers[0].newer())["manager_epoch"] == 0
        assert following.report(heard)["manager_epoch"] == 2
        assert dialers[1].newer() == [], "each is judged once"
        forged = [_lease(liar, 9) for liar in (ada, authority.replica(1))]
        replayed = _lease(manager, 1)
        assert following.report([*forged, replayed])["manager_epoch"] == 2
    finally:
        following.close()
        for dialer in dialers:
            dialer.close()
