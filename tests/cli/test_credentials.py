"""``fogft credentials`` and ``fogft join``: what they print, and what they never print."""

from __future__ import annotations

import contextlib
import io
import json
import os
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fogft.cli import main, output
from fogft.errors import FogftError, StateError
from fogft.model.replica import Member, Membership, ReplicaId
from fogft.pool.commands import composition
from fogft.pool.credentials import authority, bundle
from fogft.pool.credentials.ledger import Ledger
from fogft.pool.folder.paths import PoolPaths
from fogft.pool.folder.store import Identity, write_identity
from tests.records import certificate_names

UID = "0123456789abcdef"
POOL_FILE = """
name: planner
resources: {any_of: [{infra: local/us-west-1}]}
run: exec serve
fogft: {services: [{name: /s, type: std_srvs/srv/SetBool}]}
"""


@pytest.fixture
def paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> PoolPaths:
    """A pool no manager is running for, in a home of its own."""
    monkeypatch.setenv("FOGFT_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(bundle.SCRYPT, "n", 2)
    paths = PoolPaths.of("planner")
    authority.create_authority(paths.credentials, UID)
    write_identity(paths, Identity("planner", UID, "local", str(tmp_path / "p.yaml"), 0.0))
    paths.spec.write_text(POOL_FILE)
    return paths


def run(*words: str) -> int:
    return main.run(list(words))


def issue_ada(capsys: pytest.CaptureFixture[str]) -> str:
    """Issue a bundle for `ada`; return the passphrase that was shown."""
    assert run("credentials", "issue", "robot", "ada") == 0
    said = capsys.readouterr()
    assert said.out == "ada.join\n"
    assert "warning: the pool has no rendezvous" in said.err
    line = next(one for one in said.err.splitlines() if one.startswith("passphrase: "))
    return line.removeprefix("passphrase: ")


def test_a_second_robot_from_one_file(paths, tmp_path, capsys, monkeypatch):
    passphrase = issue_ada(capsys)
    assert stat.S_IMODE((tmp_path / "ada.join").stat().st_mode) == 0o600
    monkeypatch.setenv("FOGFT_HOME", str(tmp_path / "another machine"))
    (tmp_path / "told").write_text(passphrase + "\n")
    assert run("join", "ada.join", "--passphrase-file", "told") == 0
    said = capsys.readouterr()
    config = Path(said.out.strip())
    assert config.name == "proxy.yaml"
    assert f"fogft proxy --config {config}" in said.err
    assert "warning: the pool has no rendezvous" in said.err
    assert not (tmp_path / "ada.join").exists()


def test_the_passphrase_can_come_from_standard_input(paths, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO("a passphrase of mine\n"))
    assert run("credentials", "issue", "robot", "ada", "--passphrase-file", "-") == 0
    assert "a passphrase of mine" not in "".join(capsys.readouterr())
    monkeypatch.setattr("sys.stdin", io.StringIO("a passphrase of mine\n"))
    assert run("join", "ada.join", "--passphrase-file", "-") == 0


def test_what_is_no_exported_pool_is_refused_before_its_passphrase_is_asked_for(paths, capsys):
    issue_ada(capsys)
    assert run("import", "ada.join") == 1
    assert "lets a machine join a pool" in capsys.readouterr().err
    Path("other.file").write_text("{}")
    assert run("import", "other.file") == 1
    assert "neither a join bundle nor an exported pool" in capsys.readouterr().err


def test_without_a_terminal_it_says_how_to_give_the_passphrase(paths, capsys, monkeypatch):
    issue_ada(capsys)
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    assert run("join", "ada.join") == 1
    assert "--passphrase-file" in capsys.readouterr().err


def test_a_passphrase_that_is_not_typed_is_an_error(paths, capsys, monkeypatch):
    """Ctrl-D at the prompt."""
    issue_ada(capsys)

    def ended(_prompt):
        raise EOFError

    monkeypatch.setattr("getpass.getpass", ended)
    monkeypatch.setattr(output, "is_terminal", lambda _: True)
    assert run("join", "ada.join") == 1
    assert capsys.readouterr().err.endswith("error: no passphrase was given\n")


def test_an_exports_new_passphrase_is_shown_before_only_the_file_is_left(
    paths, capsys, monkeypatch
):
    def failing(*_, **__):
        raise FogftError("it failed")

    monkeypatch.setattr("fogft.pool.commands.moving.export", failing)
    assert run("export", "planner", "planner.pool") == 1
    assert "passphrase: " in capsys.readouterr().err


@pytest.mark.parametrize("errors", ["2>/dev/full", "2>/dev/null", "2>&-"])
@pytest.mark.parametrize("words", ["export planner p", "credentials issue robot ada"])
def test_no_file_is_made_whose_passphrase_nobody_could_read(paths, tmp_path, errors, words):
    done = subprocess.run(
        ["sh", "-c", f"{sys.executable} -m fogft {words} {errors}"], cwd=tmp_path, check=False,
        env={**os.environ, "FOGFT_HOME": str(tmp_path / "home")},
    )  # fmt: skip
    assert done.returncode == 1
    assert not [*tmp_path.glob("*.join"), *tmp_path.glob("p")]
    assert not paths.exported.exists()


def test_an_imported_pool_is_managed_though_its_file_cannot_be_deleted(
    paths, tmp_path, capsys, monkeypatch
):
    (tmp_path / "p.yaml").write_text(POOL_FILE)
    assert run("export", "planner", "planner.pool") == 0
    passphrase = capsys.readouterr().err.partition("passphrase: ")[2].splitlines()[0]
    (tmp_path / "told").write_text(passphrase)
    started = []
    monkeypatch.setattr("fogft.pool.commands.startup.start_manager", started.append)

    def refused(file):
        raise StateError(f"`{file}` cannot be removed")

    monkeypatch.setattr("fogft.pool.commands.joining.destroy", refused)
    monkeypatch.setenv("FOGFT_HOME", str(tmp_path / "other"))
    assert run("import", "planner.pool", "--passphrase-file", "told") == 1
    assert len(started) == 1
    assert "cannot be removed" in capsys.readouterr().err
    monkeypatch.setattr("fogft.pool.commands.joining.used_once", nothing_used)
    assert run("import", "planner.pool", "--passphrase-file", "told") == 1
    assert "`fogft up` manages it" in capsys.readouterr().err


def nothing_used(_root, _label):
    return contextlib.nullcontext()


def test_the_list_shows_states_and_no_key(paths, capsys):
    passphrase = issue_ada(capsys)
    assert run("credentials", "revoke", "robot", "ada") == 0
    assert "no manager has told" in capsys.readouterr().err
    assert run("credentials", "issue", "robot", "ada", "--out", "again.join") == 0
    capsys.readouterr()
    assert run("credentials", "list") == 0
    rows = [line.split()[:3] for line in capsys.readouterr().out.splitlines()]
    assert rows[1:] == [["robot", "ada.1", "revoked"], ["robot", "ada.2", "good"]]
    assert run("credentials", "list", "--json") == 0
    text = capsys.readouterr().out
    assert [(e["name"], e["generation"], e["state"]) for e in json.loads(text)] == [
        ("ada", 1, "revoked"),
        ("ada", 2, "good"),
    ]
    assert passphrase not in text
    assert "PRIVATE" not in text


def test_revoking_what_is_known_to_all_says_so(paths, capsys):
    issue_ada(capsys)
    revoked = frozenset({certificate_names.robot(UID, "ada")})
    membership = Membership("planner", UID, 1, 1, (Member(ReplicaId(UID, 0, 1), "h:1"),), revoked)
    composition.make_store("planner").write_membership(membership)
    assert run("credentials", "revoke", "robot", "ada") == 0
    assert "is revoked" in capsys.readouterr().err
    assert Ledger(paths.credentials).revoked() == revoked


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["issue", "manager", "x"], "there is no role `manager`"),
        (["issue", "robot", "a b"], "cannot be named"),
        (["issue", "replica", "3"], "not a slot for a replica"),
        (["revoke", "robot", "nobody"], "no certificate of robot `nobody`"),
        (["rotate", "gateway", "edge"], "on another machine"),
        (["rotate", "robot", "ada"], "on another machine"),
        (["rotate", "replica", "x"], "not a slot"),
    ],
)
def test_mistakes_are_told_in_one_line_with_a_hint(paths, capsys, words, said):
    assert run("credentials", *words) == 1
    text = capsys.readouterr().err
    assert said in text.splitlines()[0]
    assert "hint:" in text


def test_a_bundle_is_not_written_over(paths, capsys):
    issue_ada(capsys)
    assert run("credentials", "issue", "robot", "ada") == 1
    assert "exists" in capsys.readouterr().err
    assert len(Ledger(paths.credentials).entries()) == 1


CRASH = """
from fogft import disk
from fogft.cli import main
def write_whole(path, content, *, durable=True):
    raise RuntimeError("boom")
disk.write_whole = write_whole
main.main(["join", "ada.join", "--passphrase-file", "told"])
"""


def test_a_crash_report_holds_no_secret(paths, tmp_path, capsys, monkeypatch):
    """An error that nobody thought of ends `fogft join` while key and passphrase are in hand."""
    monkeypatch.undo()  # the other process needs as long as ever for a passphrase
    monkeypatch.setenv("FOGFT_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    passphrase = issue_ada(capsys)
    (tmp_path / "told").write_text(passphrase + "\n")
    ended = subprocess.run(
        [sys.executable, "-c", CRASH],
        env={**os.environ, "FOGFT_HOME": str(tmp_path / "another machine")},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "RuntimeError: boom" in ended.stderr
    key = bundle.open_sealed((tmp_path / "ada.join").read_bytes(), passphrase, time.time())[1]
    secrets = key["files"]["credentials/robot.key"].splitlines()[1:-1]
    for secret in (passphrase, "BEGIN", *secrets):
        assert secret not in ended.stdout + ended.stderr
