"""Which certificates there are: none is forgotten, none is issued twice, none comes back."""

from __future__ import annotations

import datetime
import functools
import stat
import threading
import time
from pathlib import Path

import pytest

from fogft.errors import CredentialError, StateError
from fogft.model.credentials import Holder, Role
from fogft.model.replica import ReplicaId
from fogft.pool.credentials import authority
from fogft.pool.credentials.ledger import Ledger

UID = "0123456789abcdef"
DAY_S = 86_400.0


class Clock:
    def __init__(self) -> None:
        self.now = time.time()

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def ledger(tmp_path: Path, clock: Clock) -> Ledger:
    authority.create_authority(tmp_path / "ca", UID)
    return Ledger(tmp_path / "ca", clock)


def again(ledger: Ledger) -> Ledger:
    """Return what another process sees."""
    return Ledger(ledger.path.parent)


def test_each_issue_is_the_next_generation(ledger: Ledger) -> None:
    """Of its own role and name; what was issued is on the list, its key is not."""
    issued = [ledger.issue_next(Role.ROBOT, "ada", UID) for _ in range(2)]
    ledger.issue_next(Role.GATEWAY, "ada", UID)
    shorts = [(e.holder.role.value, e.holder.short) for e in again(ledger).entries()]
    assert shorts == [("robot", "ada.1"), ("robot", "ada.2"), ("gateway", "ada.1")]
    said = authority.describe_pem(issued[1][1].certificate_pem)
    assert (said.common_name, said.serial) == (
        f"robot.ada.2.{UID}",
        again(ledger).entries()[1].serial,
    )
    text = ledger.path.read_text()
    assert issued[0][1].key_pem.splitlines()[1].decode() not in text
    assert stat.S_IMODE(ledger.path.stat().st_mode) == 0o600


def test_what_is_revoked_stays_revoked_and_is_not_issued_again(ledger: Ledger) -> None:
    holder, _ = ledger.issue_next(Role.ROBOT, "ada", UID)
    ledger.issue_next(Role.ROBOT, "eve", UID)
    ledger.revoke(ledger.named(Role.ROBOT, "ada"))
    ledger.revoke([holder])
    assert again(ledger).revoked() == {holder.common_name}
    assert [e.state(time.time()) for e in ledger.entries()] == ["revoked", "good"]
    with pytest.raises(CredentialError, match="is revoked"):
        ledger.issue(holder)
    assert ledger.issue_next(Role.ROBOT, "ada", UID)[0].generation == 2


def test_a_name_means_all_of_its_generations_unless_one_is_named(ledger: Ledger) -> None:
    for _ in range(3):
        ledger.issue_next(Role.ROBOT, "ada", UID)
    assert [h.short for h in ledger.named(Role.ROBOT, "ada.2")] == ["ada.2"]
    assert len(ledger.named(Role.ROBOT, "ada")) == 3
    with pytest.raises(CredentialError, match="no certificate of robot `eve`") as caught:
        ledger.named(Role.ROBOT, "eve")
    assert "`ada.1`, `ada.2`, `ada.3`" in caught.value.hint
    with pytest.raises(CredentialError):
        ledger.named(Role.GATEWAY, "ada")


def test_what_expired_is_forgotten_but_never_a_names_last_generation(
    ledger: Ledger, clock: Clock
) -> None:
    """So the list stays short, and a generation is not used twice however long ago it was."""
    for _ in range(3):
        ledger.issue_next(Role.ROBOT, "ada", UID)
    ledger.issue(Holder(Role.REPLICA, "0", 1, UID))
    for entry in ledger.entries():
        assert entry.state(entry.not_after) == "expired"
    clock.now = max(e.not_after for e in ledger.entries()) + 2 * DAY_S
    assert ledger.issue_next(Role.ROBOT, "ada", UID)[0].generation == 4
    assert [e.holder.short for e in ledger.entries()] == ["ada.3", "0.1", "ada.4"]


def test_replicas_are_due_two_months_before_their_certificates_expire(
    ledger: Ledger, monkeypatch: pytest.MonkeyPatch
) -> None:
    issue = authority.issue
    for slot, days in enumerate((59, 61)):
        monkeypatch.setattr(authority, "issue", functools.partial(issue, days=days))
        ledger.issue(Holder(Role.REPLICA, str(slot), 1, UID))
    ledger.issue_next(Role.ROBOT, "ada", UID)
    assert ledger.due(time.time()) == {ReplicaId(UID, 0, 1)}
    assert ledger.due(time.time() - 3 * DAY_S) == frozenset()
    ledger.issue(Holder(Role.REPLICA, "0", 1, UID))
    assert ledger.due(time.time()) == frozenset(), "it was stopped, and started with a new one"


@pytest.mark.parametrize("days", [30, -1])
def test_what_ends_with_the_ca_is_not_replaced_by_what_ends_then_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, days: int
) -> None:
    """A CA of an earlier version, made by a slow clock."""
    now = datetime.datetime.now(datetime.timezone.utc)
    monkeypatch.setattr(authority, "NEVER", now + datetime.timedelta(days=days))
    authority.create_authority(tmp_path / "old", UID)
    old = Ledger(tmp_path / "old")
    if days < 0:
        with pytest.raises(CredentialError, match="CA expired at"):
            old.issue(Holder(Role.REPLICA, "0", 1, UID))
    else:
        old.issue(Holder(Role.REPLICA, "0", 1, UID))
        assert old.due(time.time()) == frozenset()


def test_a_clock_that_is_years_ahead_lets_nobody_in_again(ledger: Ledger, clock: Clock) -> None:
    holder, _ = ledger.issue_next(Role.ROBOT, "eve", UID)
    ledger.revoke([holder])
    ledger.issue_next(Role.ROBOT, "eve", UID)
    clock.now += 800 * DAY_S
    ledger.issue_next(Role.ROBOT, "ada", UID)
    clock.now -= 800 * DAY_S
    assert ledger.revoked() == {holder.common_name}


@pytest.mark.parametrize("name", ["", "a b", "x" * 29, "ada.1", "../ada", "-ada"])
def test_a_name_that_fits_no_certificate_is_refused(ledger: Ledger, name: str) -> None:
    with pytest.raises(CredentialError, match="cannot be named"):
        ledger.issue_next(Role.ROBOT, name, UID)
    assert ledger.entries() == ()


def test_a_damaged_list_is_an_error_and_is_not_written_over(ledger: Ledger) -> None:
    """Going on with an empty list would let the revoked in again."""
    ledger.issue_next(Role.ROBOT, "ada", UID)
    for content in (b"{", b"[]", b'{"issued": [{}]}', b'{"issued": 7}'):
        ledger.path.write_bytes(content)
        with pytest.raises(StateError, match=r"issued\.json"):
            ledger.issue_next(Role.ROBOT, "ada", UID)
        with pytest.raises(StateError):
            ledger.revoked()
        assert ledger.path.read_bytes() == content


def test_two_at_once_lose_nothing(ledger: Ledger) -> None:
    """A manager and a command that issue at the same time get different generations."""

    def work() -> None:
        for _ in range(5):
            again(ledger).issue_next(Role.ROBOT, "ada", UID)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [e.holder.generation for e in ledger.entries()] == list(range(1, 21))
