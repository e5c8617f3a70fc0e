"""A pool's CA and what it issues."""

from __future__ import annotations

import datetime
import ssl
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from fogft.errors import CredentialError
from fogft.model.replica import ReplicaId
from fogft.pool.credentials import authority as credentials
from fogft.pool.credentials.authority import Role
from tests.records import certificate_names

UID = "0123456789abcdef"
REPLICA = ReplicaId(UID, 3, 7).certificate_name
ROBOT = certificate_names.robot(UID, "ada")
HOUR = datetime.timedelta(hours=1)


@pytest.fixture
def authority(tmp_path: Path) -> Path:
    folder = tmp_path / "ca"
    credentials.create_authority(folder, UID)
    return folder


def _write(authority: Path, name: str, role: Role, **options: float) -> Path:
    issued = credentials.issue(authority, name, role=role, **options)
    folder = authority.parent / "issued"
    credentials.write(issued, folder, role.value)
    return folder / f"{role.value}.crt"


@pytest.mark.parametrize(("name", "role"), [(REPLICA, Role.REPLICA), (ROBOT, Role.ROBOT)])
def test_a_certificate_says_who_and_what_its_holder_is(
    authority: Path, name: str, role: Role
) -> None:
    said = credentials.describe(_write(authority, name, role))
    assert (said.common_name, said.role) == (name, role.value)


def test_a_certificate_is_valid_at_once_by_any_clock_and_lasts_a_year(authority: Path) -> None:
    """A clock without a battery may say 1970."""
    now = datetime.datetime.now(datetime.timezone.utc)
    said = credentials.describe(_write(authority, REPLICA, Role.REPLICA))
    assert said.problem(now) == ""
    assert said.problem(credentials.BEGIN) == ""
    assert abs(said.not_after - (now + 365 * 24 * HOUR)) < HOUR
    assert "expired" in said.problem(now + 366 * 24 * HOUR)


def test_what_is_not_valid_yet_or_names_no_holder_is_issued_anew(
    authority: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both are from earlier versions of fogft; the former by a clock that was days ahead."""
    now = datetime.datetime.now(datetime.timezone.utc)
    assert credentials.is_good(_write(authority, ROBOT, Role.ROBOT), now)
    assert not credentials.is_good(_write(authority, f"robot.ada.{UID}", Role.ROBOT), now)
    monkeypatch.setattr(credentials, "BEGIN", now + 240 * HOUR)
    assert not credentials.is_good(_write(authority, ROBOT, Role.ROBOT), now)


@pytest.mark.parametrize("year", [1971, 2036, 2060])
def test_a_pool_outlives_the_wrong_clock_that_it_was_made_by(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, year: int
) -> None:
    """The clock is set right later: TLS takes the old CA with a new certificate."""
    folder = tmp_path / "ca"
    with monkeypatch.context() as wrong:
        wrong.setattr(credentials, "datetime", _Clock(year))
        credentials.create_authority(folder, UID)
        replica = _write(folder, REPLICA, Role.REPLICA)
    if year < 2000:  # expired since
        replica = _write(folder, REPLICA, Role.REPLICA)
    _handshake(replica, _write(folder, ROBOT, Role.ROBOT), folder)


class _Clock:
    """The module `datetime`, in another year."""

    timedelta, timezone = datetime.timedelta, datetime.timezone

    def __init__(self, year: int) -> None:
        at = datetime.datetime(year, 6, 1, tzinfo=datetime.timezone.utc)
        self.datetime = type("datetime", (), {"now": staticmethod(lambda _: at)})


def test_the_authority_never_expires_and_is_kept(authority: Path) -> None:
    """Asking for a CA again, as each `up` does, changes nothing."""
    before = [(p.name, p.read_bytes()) for p in sorted(authority.iterdir())]
    credentials.create_authority(authority, UID)
    assert [(p.name, p.read_bytes()) for p in sorted(authority.iterdir())] == before
    said = credentials.describe(authority / "ca.crt")
    assert said.role == "ca"
    assert said.not_after == credentials.NEVER


def test_no_certificate_outlives_its_authority(authority: Path) -> None:
    """A chain ends with its first end; saying more would be a lie."""
    said = credentials.describe(_write(authority, ROBOT, Role.ROBOT, days=99_999))
    assert said.not_after <= credentials.describe(authority / "ca.crt").not_after


def test_files_are_private(authority: Path) -> None:
    """Only this user enters the folder, only this user reads the files."""
    folder = _write(authority, ROBOT, Role.ROBOT).parent
    for place in (authority, folder):
        assert stat.S_IMODE(place.stat().st_mode) == 0o700
        assert {stat.S_IMODE(p.stat().st_mode) for p in place.iterdir()} == {0o600}
    assert sorted(p.name for p in folder.iterdir()) == ["ca.crt", "robot.crt", "robot.key"]


def _handshake(server: Path, client: Path, authority: Path) -> None:
    """Shake hands in memory with both ends verified; raises ssl.SSLError where TLS refuses."""
    ends = []
    for certificate, is_server in ((server, True), (client, False)):
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if is_server else ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname = False
        context.verify_mode = ssl.CERT_REQUIRED
        context.load_verify_locations(authority / "ca.crt")
        context.load_cert_chain(certificate, certificate.with_suffix(".key"))
        incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        ends.append(
            (context.wrap_bio(incoming, outgoing, server_side=is_server), incoming, outgoing)
        )
    for _ in range(6):
        for (end, _, outgoing), (_, incoming, _) in (ends, ends[::-1]):
            try:
                end.do_handshake()
                end.read(1)
            except ssl.SSLWantReadError:
                pass
            incoming.write(outgoing.read())


def test_a_robot_and_a_replica_of_one_pool_shake_hands(authority: Path) -> None:
    _handshake(
        _write(authority, REPLICA, Role.REPLICA), _write(authority, ROBOT, Role.ROBOT), authority
    )


@pytest.mark.parametrize(
    ("server", "client"),
    [(Role.ROBOT, Role.ROBOT), (Role.REPLICA, Role.REPLICA)],
    ids=["a robot cannot answer", "a replica cannot ask"],
)
def test_a_role_is_no_good_for_the_other(authority: Path, server: Role, client: Role) -> None:
    """TLS itself holds each certificate to its role."""
    with pytest.raises(ssl.SSLError):
        _handshake(
            _write(authority, "server", server), _write(authority, "client", client), authority
        )


def test_a_gateway_may_do_both(authority: Path) -> None:
    gateway = _write(authority, "gateway", Role.GATEWAY)
    _handshake(gateway, gateway, authority)


def test_another_pools_certificate_is_refused(authority: Path, tmp_path: Path) -> None:
    other = tmp_path / "other" / "ca"
    credentials.create_authority(other, "f" * 16)
    with pytest.raises(ssl.SSLError):
        _handshake(
            _write(authority, REPLICA, Role.REPLICA), _write(other, ROBOT, Role.ROBOT), authority
        )


def test_a_key_is_shown_nowhere(authority: Path) -> None:
    """Neither printing a credential nor an error about a key quotes it."""
    issued = credentials.issue(authority, ROBOT, role=Role.ROBOT)
    secret = issued.key_pem.splitlines()[1].decode()
    assert secret not in repr(issued)
    assert secret not in str(issued)
    key = authority / "ca.key"
    key.write_bytes(key.read_bytes()[:-60])
    with pytest.raises(CredentialError) as caught:
        credentials.issue(authority, ROBOT, role=Role.ROBOT)
    assert key.read_text().splitlines()[1] not in f"{caught.value} {caught.value.hint}"
    assert "ca.key" in caught.value.message


@pytest.mark.parametrize("name", ["", "x" * 65])
def test_a_name_that_fits_no_certificate_is_refused(authority: Path, name: str) -> None:
    with pytest.raises(ValueError, match=r"empty|length"):
        credentials.issue(authority, name, role=Role.ROBOT)


@pytest.mark.parametrize("content", [None, b"", b"nonsense"])
def test_a_certificate_that_cannot_be_used_is_named(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "robot.crt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CredentialError, match=str(path)):
        credentials.describe(path)


def test_keys_of_two_authorities_are_not_mixed(authority: Path, tmp_path: Path) -> None:
    """A CA's key beside another CA's certificate would sign what nobody accepts."""
    credentials.create_authority(tmp_path / "other", UID)
    (authority / "ca.key").write_bytes((tmp_path / "other" / "ca.key").read_bytes())
    with pytest.raises(CredentialError, match="does not belong"):
        credentials.issue(authority, ROBOT, role=Role.ROBOT)


def test_a_crash_before_the_certificate_was_written_is_repaired(tmp_path: Path) -> None:
    """The key comes first; a key alone is no CA, so the next call makes one."""
    folder = tmp_path / "ca"
    credentials.create_authority(folder, UID)
    (folder / "ca.crt").unlink()
    credentials.create_authority(folder, UID)
    credentials.issue(folder, ROBOT, role=Role.ROBOT)


def test_importing_it_does_not_load_cryptography() -> None:
    """The command line imports this module; it must start fast."""
    code = "import sys, fogft.pool.credentials.authority; sys.exit('cryptography' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
