"""A bundle is good for one machine: the second is refused, whatever the first does meanwhile."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from fogft.errors import CredentialError
from fogft.model.credentials import Role
from fogft.model.spec import PoolSpec, ServiceSpec
from fogft.pool.commands import joining
from fogft.pool.commands.joining import Joined
from fogft.pool.credentials import bundle, claiming
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import Identity, PoolStore, write_identity
from fogft.proxy.config import read_client
from tests.link.wire_pool import POOL_UID, Authority, wait_for
from tests.records.rendezvous_pool import Party, Rendezvous

pytestmark = pytest.mark.timeout(180)
NOW = 2e9
PASSPHRASE = "correct-horse-battery"
SPEC = PoolSpec("pool", (ServiceSpec("/s", "std_srvs/srv/SetBool"),), task={"run": "exec serve"})


@dataclass
class Scene:
    """A pool, its rendezvous, and machines that join it."""

    folder: Path
    store: PoolStore
    place: Rendezvous

    def issue(self, role: Role, name: str) -> bytes:
        return joining.issue(self.store, role, name, PASSPHRASE, NOW, open_for_s=3600)[1]

    def join(self, machine: str, data: bytes) -> Joined:
        """Join on a machine of its own, from its own copy of a bundle."""
        home = self.folder / machine
        home.mkdir(exist_ok=True)
        file = home / "a.join"
        file.write_bytes(data)
        return joining.join(file, PASSPHRASE, home, NOW)

    def keys(self, machine: str) -> list[Path]:
        return list((self.folder / machine).rglob("*.key"))


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Scene]:
    monkeypatch.setitem(bundle.SCRYPT, "n", 2)
    monkeypatch.setattr(claiming, "LIMIT_S", 60.0)
    paths = PoolPaths(tmp_path / "pool")
    authority = Authority(tmp_path / "rendezvous", ca=paths.credentials)
    place = Rendezvous(authority, "a")
    write_identity(paths, Identity("pool", POOL_UID, "local", str(tmp_path / "pool.yaml"), 0.0))
    paths.spec.write_text("any")
    spec = replace(SPEC, rendezvous=(place.endpoint,))
    yield Scene(tmp_path, PoolStore(paths, lambda *_: spec, lambda: NOW), place)
    place.kill()


@pytest.mark.parametrize(
    ("role", "name"), [(Role.ROBOT, "ada"), (Role.GATEWAY, "edge"), (Role.REPLICA, "2000")]
)
def test_a_copy_is_refused_on_a_second_machine(scene: Scene, role: Role, name: str) -> None:
    """It is told why and what to do, is left with no key, and its next bundle is welcome."""
    data = scene.issue(role, name)
    assert scene.join("first", data).holder.short == f"{name}.1"
    with pytest.raises(CredentialError, match="used before, on another machine") as caught:
        scene.join("second", data)
    assert f"fogft credentials revoke {role.value} {name}" in caught.value.hint
    assert scene.keys("second") == []
    with pytest.raises(CredentialError, match="was already used on this machine"):
        scene.join("first", data)
    assert scene.join("second", scene.issue(role, name)).holder.short == f"{name}.2"
    assert len(scene.keys("second")) == 1
    with pytest.raises(CredentialError, match="used before, on another machine"):
        scene.join("third", data)


def test_a_copy_is_refused_once_the_first_machines_proxy_has_spoken(scene: Scene) -> None:
    """Its own record takes the claim's place, and goes on standing for it."""
    data = scene.issue(Role.ROBOT, "ada")
    credentials = read_client(scene.join("first", data).config).credentials
    party = Party(credentials, scene.place.endpoint)  # type: ignore[arg-type]
    party.client.publish(claiming.RecordKind.ROBOT, "ada", 1, {"dial_in": ""})
    hearer = Party(credentials, scene.place.endpoint)  # type: ignore[arg-type]
    try:
        wait_for(lambda: hearer.orders().get(("robot", "ada")) == (1, 3))
        with pytest.raises(CredentialError, match="used before, on another machine"):
            scene.join("second", data)
    finally:
        party.client.close()
        hearer.client.close()


def test_of_machines_that_join_at_once_one_does(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They settle for longer than this machine, however busy, takes to pass a word on."""
    monkeypatch.setattr(claiming, "SETTLE_S", 4.0)
    data = scene.issue(Role.ROBOT, "ada")
    said: list[str] = []

    def join(machine: str) -> None:
        try:
            said.append(scene.join(machine, data).holder.short)
        except CredentialError as error:
            said.append(error.message)

    threads = [threading.Thread(target=join, args=(f"m{n}",)) for n in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    refused = "this bundle for `ada.1` was used before, on another machine"
    assert sorted(said) == ["ada.1", refused, refused]


def test_nobody_joins_while_nobody_can_tell(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """No rendezvous is there: what to do is said, and the bundle stays valid."""
    data = scene.issue(Role.ROBOT, "ada")
    scene.place.kill()
    with monkeypatch.context() as patch:
        patch.setattr(claiming, "LIMIT_S", 2.0)
        refused = pytest.raises(CredentialError, match="no rendezvous of the pool could confirm")
        with refused as caught:
            scene.join("first", data)
    assert "refused" in caught.value.message
    assert "stays valid" in caught.value.hint
    assert (scene.folder / "first" / "a.join").read_bytes() == data
    assert scene.keys("first") == []
    scene.place.start()
    assert scene.join("first", data).holder.short == "ada.1"


def test_whoever_was_ended_in_the_middle_joins_after_all(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The claim was made and nothing was written: this machine's second try is the same claim."""
    data = scene.issue(Role.ROBOT, "ada")
    home = scene.folder / "first"
    home.mkdir()
    (home / "a.join").write_bytes(data)

    claim = claiming.claim

    def claim_and_end(*given: object) -> None:
        claim(*given)  # type: ignore[arg-type]
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(claiming, "claim", claim_and_end)
        with pytest.raises(KeyboardInterrupt):
            joining.join(home / "a.join", PASSPHRASE, home, NOW)
    assert scene.keys("first") == []
    assert scene.join("first", data).holder.short == "ada.1"


def test_a_rendezvous_joins_before_there_is_one(scene: Scene) -> None:
    """It has to: its own certificate can neither ask, answer nor sign."""
    data = scene.issue(Role.RENDEZVOUS, "b")
    scene.place.kill()
    assert scene.join("meet", data).command == "rendezvous"


def test_of_two_claims_the_earlier_is_the_greater_text(tmp_path: Path) -> None:
    claims = tmp_path / "claims.json"
    tokens = [claiming.own_token(claims, str(n), NOW + n / 1000) for n in range(5)]
    assert tokens == sorted(tokens, reverse=True)
    assert len({claiming.own_token(claims, f"at once {n}", NOW) for n in range(50)}) == 50
