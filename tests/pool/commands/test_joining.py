"""A join bundle: opened with its passphrase only, in its time only, and once."""

from __future__ import annotations

import base64
import json
import stat
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fogft.errors import CredentialError
from fogft.model.credentials import CredentialPaths, Role
from fogft.model.membership import from_dict
from fogft.model.proxy_config import RendezvousConfig
from fogft.model.replica import Member, Membership, ReplicaId
from fogft.model.spec import PoolSpec, ServiceSpec
from fogft.pool.commands import joining
from fogft.pool.credentials import authority, bundle
from fogft.pool.credentials.bundle import Label
from fogft.pool.credentials.ledger import Ledger
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import Identity, PoolStore, write_identity
from fogft.poolfile import config_file
from fogft.proxy.config import read_client, read_server
from tests.nightly import by_day

UID, NOW = "0123456789abcdef", 2e9
PASSPHRASE = "correct-horse-battery"
SPEC = PoolSpec("pool", (ServiceSpec("/s", "std_srvs/srv/SetBool"),), task={"run": "exec serve"})
MEMBERSHIP = Membership("pool", UID, 3, 4, (Member(ReplicaId(UID, 0, 1), "10.0.0.1:7447"),))
LABEL = Label("id", "pool", f"robot.ada.1.{UID}", NOW, NOW + 60)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A passphrase is not made slow to guess here."""
    monkeypatch.setitem(bundle.SCRYPT, "n", 2)


@pytest.fixture
def store(tmp_path: Path) -> PoolStore:
    return store_of(SPEC, tmp_path)


def store_of(spec: PoolSpec, tmp_path: Path) -> PoolStore:
    paths = PoolPaths(tmp_path / "pool")
    authority.create_authority(paths.credentials, UID)
    write_identity(paths, Identity("pool", UID, "local", str(tmp_path / "pool.yaml"), 0.0))
    paths.spec.write_text("any")
    store = PoolStore(paths, lambda *_: spec, lambda: NOW)
    store.write_membership(MEMBERSHIP)
    return store


@pytest.fixture
def file(store: PoolStore, tmp_path: Path) -> Path:
    path = tmp_path / "ada.join"
    path.write_bytes(issued(store, Role.ROBOT, "ada"))
    return path


def issued(store: PoolStore, role: Role, name: str) -> bytes:
    return joining.issue(store, role, name, PASSPHRASE, NOW, open_for_s=3600)[1]


def test_a_robot_joins_from_one_file(file: Path, tmp_path: Path) -> None:
    """All that its proxy needs is there, private, and belongs together."""
    joined = joining.join(file, PASSPHRASE, tmp_path / "home", NOW)
    assert (joined.command, joined.holder.short) == ("proxy", "ada.1")
    config = read_client(joined.config)
    assert (config.robot, config.pool_uid, config.services) == ("ada", UID, SPEC.services)
    assert from_dict(json.loads(config.membership.read_text())) == MEMBERSHIP
    said = authority.describe(config.credentials.certificate)
    assert (said.common_name, said.role) == (f"robot.ada.1.{UID}", "robot")
    for path in [joined.config, *joined.config.parent.rglob("*")]:
        assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600), path


def test_what_another_pool_of_the_same_name_has_set_up_stays(file: Path, tmp_path: Path) -> None:
    """Its proxy may run from there. The bundle is still good once that is removed."""
    folder = tmp_path / "home" / "joined" / "pool.robot.ada"
    folder.mkdir(parents=True)
    (folder / "proxy.yaml").write_text(f"pool_uid: {'f' * 16}")
    with pytest.raises(CredentialError, match="belongs to another pool"):
        joining.join(file, PASSPHRASE, tmp_path / "home", NOW)
    assert [path.name for path in folder.iterdir()] == ["proxy.yaml"]
    (folder / "proxy.yaml").unlink()
    assert joining.join(file, PASSPHRASE, tmp_path / "home", NOW).config.parent == folder


def test_a_replica_by_hand_joins_too(tmp_path: Path) -> None:
    """In a slot that the manager leaves alone; it dials the robot."""
    store = store_of(replace(SPEC, dial_in="ada.example:7460"), tmp_path)
    path = tmp_path / "lab.join"
    path.write_bytes(issued(store, Role.REPLICA, "2000"))
    joined = joining.join(path, PASSPHRASE, tmp_path / "home", NOW)
    assert joined.command == "serve"
    config = read_server(joined.config)
    assert config.id == ReplicaId(UID, 2000, 1)
    assert authority.describe(config.credentials.certificate).role == "replica"
    for slot in ("3", "100", "1999", "1000000", "02000", "x", "-1", "1²00", "9" * 30):
        with pytest.raises(CredentialError, match="not a slot for a replica"):
            issued(store, Role.REPLICA, slot)


def test_a_rendezvous_joins_too(store: PoolStore, tmp_path: Path) -> None:
    """Its file is all that a small reachable machine needs."""
    path = tmp_path / "meet.join"
    path.write_bytes(issued(store, Role.RENDEZVOUS, "meet"))
    joined = joining.join(path, PASSPHRASE, tmp_path / "home", NOW)
    assert joined.command == "rendezvous"
    config = config_file.read(RendezvousConfig, joined.config)
    said = authority.describe(config.credentials.certificate)
    assert (said.common_name, said.role) == (f"rendezvous.meet.1.{UID}", "rendezvous")
    assert config.credentials.key.exists()
    assert config.credentials.ca.exists()


def test_a_gateway_joins_too(store: PoolStore, tmp_path: Path) -> None:
    """With all that it listens and asks with, and the membership as it was."""
    path = tmp_path / "edge.join"
    path.write_bytes(issued(store, Role.GATEWAY, "edge"))
    joined = joining.join(path, PASSPHRASE, tmp_path / "home", NOW)
    assert (joined.command, joined.holder.role) == ("gateway", Role.GATEWAY)
    config = read_client(joined.config)
    assert (config.robot, config.listen) == ("edge", "0.0.0.0:7470")
    assert from_dict(json.loads(config.membership.read_text())) == MEMBERSHIP
    said = authority.describe(config.credentials.certificate)
    assert said.common_name == f"gateway.edge.1.{UID}"


@pytest.mark.parametrize(
    ("spec", "role", "name"),
    [
        (SPEC, Role.REPLICA, "2000"),
        (replace(SPEC, dial_in="ada.example:7460"), Role.ROBOT, "bob"),
        (replace(SPEC, dial_in="ada.example:7460"), Role.GATEWAY, "edge"),
    ],
)
def test_who_would_find_nobody_gets_no_bundle(
    tmp_path: Path, spec: PoolSpec, role: Role, name: str
) -> None:
    """Where there is no rendezvous; no generation is used up, and the remedy is named."""
    store = store_of(spec, tmp_path)
    with pytest.raises(CredentialError, match=r"would find|could not be found") as caught:
        issued(store, role, name)
    assert "fogft.rendezvous" in caught.value.hint
    assert not Ledger(store.paths.credentials).entries()


def test_who_is_alone_is_told(file: Path, store: PoolStore, tmp_path: Path) -> None:
    """A robot joins without a rendezvous: it has the replicas' endpoints, and hears of no more."""
    assert joining.join(file, PASSPHRASE, tmp_path / "home", NOW).alone
    meet = tmp_path / "meet.join"
    meet.write_bytes(issued(store, Role.RENDEZVOUS, "meet"))
    assert not joining.join(meet, PASSPHRASE, tmp_path / "home", NOW).alone


def test_it_is_good_for_one_time(file: Path, tmp_path: Path) -> None:
    """The file is gone, and a copy is refused here."""
    copy = tmp_path / "copy"
    copy.write_bytes(file.read_bytes())
    joining.join(file, PASSPHRASE, tmp_path / "home", NOW)
    assert not file.exists()
    with pytest.raises(CredentialError, match="was already used on this machine"):
        joining.join(copy, PASSPHRASE, tmp_path / "home", NOW)
    with pytest.raises(CredentialError, match="cannot be read"):
        joining.join(file, PASSPHRASE, tmp_path / "home", NOW)


def test_joining_again_brings_the_next_generation(
    store: PoolStore, file: Path, tmp_path: Path
) -> None:
    """To the same place, so that a proxy that runs takes it into use."""
    first = joining.join(file, PASSPHRASE, tmp_path / "home", NOW)
    file.write_bytes(issued(store, Role.ROBOT, "ada"))
    second = joining.join(file, PASSPHRASE, tmp_path / "home", NOW)
    assert (second.holder.generation, second.config) == (2, first.config)
    said = authority.describe(read_client(second.config).credentials.certificate)
    assert said.common_name == f"robot.ada.2.{UID}"


def test_a_wrong_passphrase_opens_nothing_and_spoils_nothing(file: Path, tmp_path: Path) -> None:
    with pytest.raises(CredentialError, match="passphrase is wrong"):
        joining.join(file, "wrong-horse-battery", tmp_path / "home", NOW)
    assert not (tmp_path / "home").exists()
    joining.join(file, PASSPHRASE, tmp_path / "home", NOW)


def test_its_time_ends_and_cannot_be_prolonged(file: Path, tmp_path: Path) -> None:
    with pytest.raises(CredentialError, match="expired at") as caught:
        joining.join(file, PASSPHRASE, tmp_path / "home", NOW + 3600)
    assert "this machine's clock says" in caught.value.hint
    raw = json.loads(file.read_text())
    raw["open_until"] += 1e6
    file.write_text(json.dumps(raw))
    with pytest.raises(CredentialError, match="passphrase is wrong, or the bundle was changed"):
        joining.join(file, PASSPHRASE, tmp_path / "home", NOW + 3600)


@pytest.mark.parametrize("passphrase", ["", "short", " " * 20])
def test_a_passphrase_that_is_too_short_uses_no_generation_up(
    store: PoolStore, passphrase: str
) -> None:
    with pytest.raises(CredentialError, match="shorter than 12"):
        joining.issue(store, Role.ROBOT, "ada", passphrase, NOW, open_for_s=60)
    holder, _ = joining.issue(store, Role.ROBOT, "ada", PASSPHRASE, NOW, open_for_s=60)
    assert holder.generation == 1


def test_nothing_secret_is_readable(file: Path, tmp_path: Path) -> None:
    """Neither the key nor who may be reached; the passphrase is nowhere."""
    data = file.read_bytes()
    joined = joining.join(file, PASSPHRASE, tmp_path / "home", NOW)
    key = read_client(joined.config).credentials.key.read_bytes().splitlines()[1]
    sealed = base64.b64decode(json.loads(data)["sealed"])
    for secret in (key, b"10.0.0.1", PASSPHRASE.encode()):
        assert secret not in data
        assert secret not in sealed


def test_made_passphrases_differ_and_are_long_enough() -> None:
    made = {bundle.new_passphrase() for _ in range(50)}
    assert len(made) == 50
    for passphrase in made:
        bundle.check_passphrase(passphrase)


@pytest.mark.parametrize("named", ["a:1", ["a"], [1], ["a:1", None], [["a:1"]]])
def test_a_bundle_names_no_odd_rendezvous(named: object, tmp_path: Path) -> None:
    path = tmp_path / "evil.join"
    content = {"files": {"proxy.yaml": "{}"}, "rendezvous": named}
    path.write_bytes(bundle.seal(LABEL, content, PASSPHRASE))
    with pytest.raises(CredentialError, match=r"content is invalid: rendezvous"):
        joining.join(path, PASSPHRASE, tmp_path / "home", NOW)


@pytest.mark.parametrize(
    "name", ["../x", "/etc/x", "a/b/c", "", ".", "..", "x\0y", "manager.json", "proxy.yaml\n"]
)
def test_a_bundle_can_write_nowhere_else(name: str, tmp_path: Path) -> None:
    """Even one that was sealed with the right passphrase by somebody hostile."""
    path = tmp_path / "evil.join"
    path.write_bytes(bundle.seal(LABEL, {"files": {name: "x"}}, PASSPHRASE))
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(CredentialError, match="is not a file of a bundle"):
        joining.join(path, PASSPHRASE, tmp_path / "home", NOW)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    "config", ["status: /home/ada/.bashrc", "lock: ../x", "credentials: {key: /etc/shadow}"]
)
def test_what_a_bundle_sets_up_writes_nowhere_else(config: str, tmp_path: Path) -> None:
    """Nor does the proxy that the machine is told to start, which writes its status."""
    path = tmp_path / "evil.join"
    path.write_bytes(bundle.seal(LABEL, {"files": {"proxy.yaml": config}}, PASSPHRASE))
    with pytest.raises(CredentialError, match="unexpected name"):
        joining.join(path, PASSPHRASE, tmp_path / "home", NOW)


@settings(max_examples=by_day(60, at_night=2000))
@given(st.data())
def test_any_damage_is_told(data: st.DataObject) -> None:
    """One changed, added or missing byte, wherever: an error, never another content."""
    sealed = bundle.seal(LABEL, {"files": {"a": "b"}}, PASSPHRASE)
    at = data.draw(st.integers(0, len(sealed) - 1))
    put = data.draw(st.binary(max_size=3))
    damaged = sealed[:at] + put + sealed[at + data.draw(st.integers(0, 2)) :]
    try:
        opened = bundle.open_sealed(damaged, PASSPHRASE, NOW)
    except CredentialError:
        return
    assert opened == (LABEL, {"files": {"a": "b"}})  # white space only


@given(
    st.binary(max_size=300)
    | st.text().map(lambda t: json.dumps({"fogft_bundle": 1, "id": t}).encode())
)
def test_garbage_is_no_bundle(data: bytes) -> None:
    with pytest.raises(CredentialError, match="neither a join bundle nor an exported pool"):
        bundle.read_label(data)


def test_a_join_that_is_killed_leaves_no_key_for_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither a key of its own, nor that of one before it that was killed."""
    store = store_of(replace(SPEC, rendezvous=("10.0.0.9:7450",)), tmp_path)
    file = tmp_path / "ada.join"
    file.write_bytes(issued(store, Role.ROBOT, "ada"))
    left = tmp_path / "home" / "joined" / "claiming"
    left.mkdir(parents=True)
    (left / "robot.key").write_text("of one that was killed")
    seen = []

    def claim(*told: object) -> None:
        place = told[-1]
        assert isinstance(place, CredentialPaths)
        seen.append((place.key.parent, place.key.read_text()))

    monkeypatch.setattr(joining.claiming, "claim", claim)
    joining.join(file, PASSPHRASE, tmp_path / "home", NOW)
    [(folder, key)] = seen
    assert folder == left
    assert "PRIVATE KEY" in key
    assert not left.exists()
