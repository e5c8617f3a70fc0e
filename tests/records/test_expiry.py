"""When a certificate expires, and who hears of it in time."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from fogft.model.credentials import Role
from fogft.model.proxy_config import ClientProxyConfig, ServerProxyConfig
from fogft.model.replica import ReplicaId
from fogft.pool.credentials import authority as authorities
from fogft.proxy.replica.announcing import Presence
from fogft.proxy.robot.following import Following
from fogft.records import expiry
from fogft.records.expiry import Expiry, end_of
from tests.link.wire_pool import POOL_UID, Authority, wait_for
from tests.records import certificate_names
from tests.records.rendezvous_pool import Rendezvous

DAY_S = 86_400.0


def test_a_certificate_is_read_also_as_it_comes_from_elsewhere(tmp_path: Path) -> None:
    import ssl

    authorities.create_authority(tmp_path, POOL_UID)
    pem = (tmp_path / "ca.crt").read_bytes()
    read = end_of(pem)
    der = ssl.PEM_cert_to_DER_cert(pem.decode())
    assert read == end_of(ssl.DER_cert_to_PEM_cert(der).encode())
    assert read == authorities.NEVER.timestamp()


@pytest.mark.parametrize("junk", [b"", b"x", b"-----BEGIN CERTIFICATE-----", b"\x30" * 99])
def test_what_is_no_certificate_has_no_end(junk: bytes) -> None:
    assert end_of(junk) is None


def test_it_is_told_at_start_and_once_a_day_until_it_is_renewed(
    authority: Authority, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    now = time.time()
    robot = authority.issue(certificate_names.robot(POOL_UID, "ada"), Role.ROBOT, days=365)
    seen = Expiry(robot.certificate)
    told = []
    for days in (300, 334, 335.5, 335.6, 336.5, 336.6):
        monkeypatch.setattr(expiry.time, "time", lambda days=days: now + days * DAY_S)
        left_s = seen.look()
        assert left_s == pytest.approx((365 - days) * DAY_S, abs=DAY_S / 100)
        told.append(len(caplog.messages))
    assert told == [0, 0, 1, 1, 2, 2]
    assert f"certificate_expires in_days=29 path={robot.certificate}" in caplog.messages[0]
    authority.issue(certificate_names.robot(POOL_UID, "ada"), Role.ROBOT, days=365 * 2)
    assert (seen.look() or 0.0) > 365 * DAY_S
    assert len(caplog.messages) == 2


def test_a_missing_certificate_has_no_end(tmp_path: Path) -> None:
    assert Expiry(tmp_path / "robot.crt").look() is None


def _robot(authority: Authority, folder: Path) -> None:
    files = authority.issue(certificate_names.robot(POOL_UID, "ada"), Role.ROBOT, days=5)
    config = ClientProxyConfig(
        pool="p", pool_uid=POOL_UID, credentials=files, services=(), robot="ada",
        membership=folder / "a", status=folder / "b", lock=folder / "c",
    )  # fmt: skip
    assert 4 * DAY_S < Following(config).report()["certificate_left_s"] < 5 * DAY_S


def _replica(authority: Authority, _: Path) -> None:
    files = authority.issue(ReplicaId(POOL_UID, 1000, 1).certificate_name, Role.REPLICA, days=5)
    config = ServerProxyConfig(
        pool="p", pool_uid=POOL_UID, credentials=files, services=(), slot=1000, generation=1
    )
    Presence(config, "127.0.0.1:1").look(frozenset(), draining=False)


@pytest.mark.parametrize("look", [_robot, _replica])
def test_each_proxy_looks_at_its_own(
    authority: Authority, tmp_path: Path, caplog: pytest.LogCaptureFixture,
    look: Callable[[Authority, Path], None],
) -> None:  # fmt: skip
    look(authority, tmp_path)
    assert [said.split()[0] for said in caplog.messages] == ["certificate_expires"]


def test_a_rendezvous_looks_at_its_own(authority: Authority) -> None:
    name = certificate_names.rendezvous(POOL_UID, "meet")
    files = authority.issue(name, Role.RENDEZVOUS, days=5)
    rendezvous = Rendezvous(authority, "meet", files=files)
    try:
        log = rendezvous.folder / "log"
        wait_for(lambda: "certificate_expires" in log.read_text())
    finally:
        rendezvous.kill()
