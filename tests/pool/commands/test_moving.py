"""What `fogft export` and `import` refuse, and that a refusal changes nothing."""

from __future__ import annotations

import contextlib
import errno
from concurrent.futures import ThreadPoolExecutor

import pytest

from fogft import disk
from fogft.errors import CredentialError, FogftError, PoolBusy
from fogft.model.credentials import Role
from fogft.pool.commands import change, joining, moving
from fogft.pool.commands.composition import make_store
from fogft.pool.credentials import bundle
from fogft.pool.credentials.authority import create_authority
from fogft.pool.credentials.ledger import Ledger
from fogft.pool.folder.lease import read_epoch
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import read_identity
from tests.fakes.pools import UID, lay_down
from tests.fakes.threads import amid

SECRET = "correct horse battery staple"
NOW = 1_000_000.0


@pytest.fixture(autouse=True)
def quick():
    """A passphrase is not made slow to guess here, whatever a test undoes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(bundle.SCRYPT, "n", 2)
        yield


@pytest.fixture
def made(tmp_path, monkeypatch):
    """A pool without processes, and where its file would be."""
    monkeypatch.setenv("FOGFT_HOME", str(tmp_path / "home"))
    paths = lay_down(tmp_path / "home", None)
    create_authority(paths.credentials, UID)
    Ledger(paths.credentials).issue_next(Role.ROBOT, "ada", UID)
    return make_store("planner"), tmp_path / "planner.pool"


def export(store, file, now=NOW):
    return moving.export(store, store.paths.folder.parents[1], file, SECRET, now, open_for_s=60)


def test_what_is_moved_is_the_same_pool_under_a_later_epoch(made, tmp_path):
    store, file = made
    pool_file = tmp_path / "elsewhere.yaml"
    pool_file.write_text(store.paths.spec.read_text())
    before = {p.name: p.read_bytes() for p in store.paths.credentials.glob("*[!k]")}
    was = export(store, file)
    with pytest.raises(PoolBusy, match="exported from this machine"):
        store.identity()
    new = tmp_path / "new"
    moving.import_(file, SECRET, new, NOW + 59, pool_file=pool_file)
    paths = PoolPaths.of(was.name, new)
    assert before
    for name, content in before.items():
        assert (paths.credentials / name).read_bytes() == content
        assert (paths.credentials / name).stat().st_mode & 0o777 == 0o600
    assert paths.spec.read_bytes() == store.paths.spec.read_bytes()
    assert read_identity(paths).first_epoch > read_epoch(store.paths)


def test_an_export_comes_back_where_it_was_made(made, tmp_path):
    store, file = made
    pool_file = tmp_path / "pool.yaml"
    pool_file.write_text("")
    was = export(store, file)
    moving.import_(file, SECRET, tmp_path / "home", NOW, pool_file=pool_file)
    assert store.identity().uid == was.uid
    assert not store.paths.exported.exists()


def test_what_is_refused_leaves_the_file_and_no_pool(made, tmp_path):
    store, file = made
    export(store, file)
    sealed, new = file.read_bytes(), tmp_path / "new"
    with pytest.raises(CredentialError, match="expired"):
        moving.import_(file, SECRET, new, NOW + 61)
    with pytest.raises(CredentialError, match="passphrase is wrong"):
        moving.import_(file, SECRET + "x", new, NOW)
    with pytest.raises(FogftError, match="is not on this machine"):
        moving.import_(file, SECRET, new, NOW, pool_file=tmp_path / "nowhere.yaml")
    assert file.read_bytes() == sealed
    assert not PoolPaths.of("planner", new).identity.exists()


@pytest.mark.parametrize("where", ["file", "name", "cloud"])
def test_a_file_that_somebody_else_made_writes_nothing_elsewhere(made, tmp_path, where):
    """Whoever is handed a file and its passphrase takes over a pool, and no other file."""
    store, file = made
    export(store, file)
    outside = tmp_path / "outside"
    label, content = bundle.open_sealed(file.read_bytes(), SECRET, NOW)
    if where == "file":
        content["files"] = {"pool//etc/x": "x"}
    else:
        content["identity"][where] = str(outside)
        content["files"] = {"cloud/a": "x", "pool/b": "x"}
    file.write_bytes(bundle.seal(label, content, SECRET))
    (tmp_path / "pool.yaml").write_text("")
    with pytest.raises(FogftError):
        moving.import_(file, SECRET, tmp_path / "new", NOW, pool_file=tmp_path / "pool.yaml")
    assert not outside.exists()


def test_a_join_bundle_moves_no_pool(made, tmp_path):
    store, _ = made
    spec = store.paths.spec.read_text()
    store.paths.spec.write_text(spec + "  rendezvous: [127.0.0.1:7450]\n")
    bundle = tmp_path / "ada.join"
    _, data = joining.issue(store, Role.ROBOT, "ada", SECRET, NOW, open_for_s=60)
    bundle.write_bytes(data)
    with pytest.raises(FogftError, match="contains no pool"):
        moving.import_(bundle, SECRET, tmp_path / "new", NOW)


def test_a_folder_that_cannot_be_written_to_ends_no_manager(made, tmp_path, monkeypatch):
    store, _ = made
    started, told = [], []
    monkeypatch.setattr(moving.startup, "start_manager", started.append)
    place = tmp_path / "no folder" / "planner.pool"
    with pytest.raises(FogftError, match="is no folder to write to"):
        moving.export(store, tmp_path, place, SECRET, NOW, open_for_s=60, told=told.append)
    assert started == told == []
    assert store.identity().name == "planner"


def test_a_pool_without_its_credentials_stays(made, monkeypatch):
    """What the file must hold cannot be read: the manager is started again."""
    store, file = made
    started = []
    monkeypatch.setattr(moving.startup, "start_manager", started.append)
    store.paths.credentials.rename(store.paths.folder / "lost")
    with pytest.raises(FogftError, match=r"`.*credentials` is needed: No such file"):
        export(store, file)
    assert started == [store]
    assert not file.exists()
    assert store.identity()


@pytest.mark.parametrize("where", ["interrupted", "full disk", "exported"])
def test_an_export_that_ends_early_starts_the_manager_again_or_keeps_the_file(
    made, tmp_path, monkeypatch, where
):
    """Until the pool is exported it is managed here; from then on the file is all that is left."""
    store, file = made
    started = []
    monkeypatch.setattr(moving.startup, "start_manager", started.append)

    def interrupted(*_):
        raise KeyboardInterrupt

    if where == "interrupted":
        monkeypatch.setattr(moving.bundle, "seal", interrupted)
    elif where == "full disk":
        monkeypatch.setattr(moving.disk, "write_whole", full_disk)
    else:
        monkeypatch.setattr(moving.shutdown, "without_orders", interrupting_at_its_end)
    with pytest.raises((KeyboardInterrupt, FogftError)):
        export(store, file)
    unfinished = file.with_name("planner.pool.unfinished")
    if where == "exported":
        assert started == []
        assert b"planner" in unfinished.read_bytes()
    else:
        assert started == [store]
        assert store.identity().name == "planner"
        with contextlib.suppress(NotADirectoryError):
            assert not unfinished.exists()


def full_disk(path, *_):
    raise OSError(errno.ENOSPC, "No space left on device", str(path))


@contextlib.contextmanager
def interrupting_at_its_end(*_):
    yield
    raise KeyboardInterrupt


def test_an_import_that_is_killed_can_be_repeated(made, tmp_path, monkeypatch):
    """Never are both files there: `down` would remove the keys, and ask no cloud."""
    store, file = made
    (tmp_path / "pool.yaml").write_text("")
    export(store, file)

    def killed(paths, identity):
        raise KeyboardInterrupt

    monkeypatch.setattr(moving, "write_identity", killed)
    with pytest.raises(KeyboardInterrupt):
        moving.import_(file, SECRET, tmp_path / "home", NOW, pool_file=tmp_path / "pool.yaml")
    assert not store.paths.exported.exists()
    assert not store.paths.identity.exists()
    monkeypatch.undo()
    moving.import_(file, SECRET, tmp_path / "home", NOW, pool_file=tmp_path / "pool.yaml")


@pytest.mark.parametrize("what", ["revoke", "rotate", "issue"])
def test_certificates_do_not_change_while_the_pool_is_exported(made, what):
    """What the file was sealed with would be the older word, for ever."""
    store, _ = made
    before = store.paths.credentials.joinpath("issued.json").read_bytes()
    failures = []

    def asked():
        try:
            if what == "revoke":
                change.revoke_credentials(store, Role.ROBOT, "ada")
            elif what == "rotate":
                change.rotate_robot(store)
            else:
                joining.issue(store, Role.GATEWAY, "edge", SECRET, NOW, open_for_s=60)
        except FogftError as error:
            failures.append(error)

    with ThreadPoolExecutor(1) as threads:
        with disk.locked(store.paths.intent_lock):
            asking = amid(threads, asked, store.paths.intent_lock)
            store.paths.identity.rename(store.paths.exported)
        asking.result(30)
    assert [type(failure) for failure in failures] == [PoolBusy]
    assert store.paths.credentials.joinpath("issued.json").read_bytes() == before
