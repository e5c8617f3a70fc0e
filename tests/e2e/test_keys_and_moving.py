"""A second robot, new keys while requests flow, the door closed on a robot, and a move.

One pool serves all of it: `fogft credentials`, then `fogft export` and `fogft import`.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
from pathlib import Path

import pytest

from tests.e2e.pool import Client, Machine, Pool
from tests.link.freezing import freeze

pytestmark = [pytest.mark.e2e, pytest.mark.ros, pytest.mark.timeout(400)]
SECRET = "a passphrase that unknown"


@pytest.fixture
def ada(pool, ros_domains):
    pool.write(replicas=2)
    pool.up()
    joined = Machine(pool, "robot", "ada", ros_domains())
    joined.start()
    yield joined
    joined.kill()


def links(machine: Machine) -> list[dict]:
    return machine.report().get("links", [])


def flawless(result: dict) -> bool:
    return result["failed"] == result["wrong"] == result["twice"] == 0


def generations(pool: Pool) -> list[str]:
    """Return the ready replicas' generations."""
    return sorted(str(r["generation"]) for r in pool.status()["replicas"] if r["phase"] == "ready")


def test_keys_change_and_the_pool_moves_and_no_request_is_lost(pool, ada):
    new_keys_and_a_revocation_lose_no_request(pool, ada)
    it_moves_under_load_and_is_managed_by_one_machine_only(pool)


def new_keys_and_a_revocation_lose_no_request(pool: Pool, ada: Machine) -> None:
    """Both robots use both replicas; then keys change twice over, and ada is shut out."""
    pool.wait(lambda: [link["state"] for link in links(ada)] == ["up", "up"])
    first = pool.client(120, 5)
    second = Client(ada.environ, 6, 10, 12.0)
    result = second.result()
    assert result["requests"] > 10
    assert flawless(result), result
    freeze(ada.process.pid)  # a frozen robot holds nobody up
    assert "is revoked" in pool_said(pool, "credentials", "rotate", "robot")
    os.kill(ada.process.pid, signal.SIGCONT)
    pool.wait(lambda: [link["state"] for link in links(ada)] == ["up", "up"])
    pool.fogft("credentials", "revoke", "robot", "ada")
    pool.wait(lambda: {link["detail"] for link in links(ada)} == {"our certificate is revoked"})
    pool.fogft("credentials", "rotate", "replica")
    pool.wait(lambda: generations(pool) == ["2", "2"])
    result = first.finish()
    assert result["requests"] > 50  # five a second, for as long as all this takes
    assert flawless(result), result
    states = [line.split()[:3] for line in pool.fogft("credentials", "list").splitlines()[1:]]
    assert ["robot", "ada.1", "revoked"] in states
    assert sorted(state for role, name, state in states if name.endswith("2")) == ["good"] * 3
    assert secrets_told(pool, ada) == []


def it_moves_under_load_and_is_managed_by_one_machine_only(pool: Pool) -> None:
    """No request is lost, no replica replaced, and the old machine can do nothing to it.

    Nor can another one that imports a copy: either that or the first is told, and steps back.
    """
    secret, file = pool.folder / "secret", pool.folder / "e2e.pool"
    secret.write_text(f"{SECRET}\n")
    given = ("--passphrase-file", str(secret))
    pool.wait(lambda: len(machines(pool)) == 2)
    before = machines(pool)
    epoch = json.loads((pool.folder / "home/pools/e2e/lease.json").read_text())["epoch"]
    client = pool.client(300, 5)

    assert pool.fogft("export", "e2e", str(file), *given).strip() == str(file)
    assert b"e2e" in file.read_bytes()
    assert b"PRIVATE KEY" not in file.read_bytes()
    assert file.stat().st_mode & 0o777 == 0o600
    for words in (
        ("up", str(pool.file), "--yes"),
        ("manager", "e2e"),
        ("scale", "up", "1", "-p", "e2e"),
        ("export", "e2e", "again.pool", *given),
    ):
        assert "exported from this machine" in pool.fogft(*words, ok=False), words

    other, third = Elsewhere(pool), Elsewhere(pool, "third")
    try:
        wrong = pool.folder / "wrong"
        wrong.write_text("another passphrase\n")
        said = other.fogft("import", str(file), "--passphrase-file", str(wrong), ok=False)
        assert "the passphrase is wrong" in said
        copy = Path(f"{file}.copy")
        copy.write_bytes(file.read_bytes())
        other.fogft("import", str(file), *given)
        assert not file.exists()
        assert "already used" in other.fogft("import", str(copy), *given, ok=False)
        other.wait(other.manages)
        assert other.epoch() > epoch
        third.fogft("import", str(copy), *given)
        exported = [one.home / "pools/e2e/exported.json" for one in (other, third)]
        other.wait(lambda: any(path.exists() for path in exported))
        if exported[0].exists():
            other, third = third, other
        other.wait(other.manages)
        assert "imported on another later" in third.fogft("scale", "up", "1", "-p", "e2e", ok=False)
        third.fogft("down", "e2e")
        pool.fogft("down", "e2e")
        assert not (pool.folder / "home/pools/e2e").exists()
        assert machines(pool) == before, "the old machine ended nothing, the new one kept all"
        result = client.finish()
        assert result["requests"] > 20
        assert result["failed"] == result["wrong"] == result["twice"] == 0, result

        other.fogft("scale", "up", "1", "--wait")
        assert machines(pool) > before
    finally:
        third.fogft("down", "e2e", ok=False)
        other.fogft("down", ok=False)
    assert machines(pool) == set()


def pool_said(pool: Pool, *words: str) -> str:
    """Run a command; return all that it prints."""
    return pool.fogft(*words, ok=False)


def secrets_told(pool: Pool, ada: Machine) -> list[str]:
    """Return where a key or the passphrase stands that is no key's own file (0600)."""
    secrets, open_to_others, files, lines = {SECRET.encode()}, [], {}, []
    for folder, _, names in os.walk(pool.folder):
        for path in (Path(folder, name) for name in names if name != "secret"):
            if not path.is_file():  # a pipe, or gone
                continue
            with contextlib.suppress(FileNotFoundError):  # it has just been replaced, or ended
                content = path.read_bytes()
                if path.suffix != ".key":
                    files[path] = content
                    continue
                secrets.add(content.splitlines()[2])
                if path.stat().st_mode & 0o077:
                    open_to_others.append(str(path))
    told = [str(path) for path, content in files.items() if any(s in content for s in secrets)]
    for pid in [*pool.processes(), ada.process.pid]:
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            lines.append(Path(f"/proc/{pid}/cmdline").read_bytes())
    status = pool.fogft("status", "--json").encode()
    return (
        open_to_others + told + [repr(t) for t in (*lines, status) if any(s in t for s in secrets)]
    )


class Elsewhere(Pool):
    """Another machine with a home of its own, which reaches the same (local) cloud."""

    def __init__(self, pool: Pool, name: str = "elsewhere") -> None:
        super().__init__(pool.folder, int(pool.environ["ROS_DOMAIN_ID"]))
        self.home = pool.folder / name
        self.home.mkdir()
        (self.home / "local").symlink_to(pool.folder / "home" / "local")
        self.environ["FOGFT_HOME"] = str(self.home)

    def epoch(self) -> int:
        return int(json.loads((self.home / "pools/e2e/lease.json").read_text())["epoch"])

    def manages(self) -> bool:
        """Whether its manager sees two replicas that answer through its own client proxy."""
        status = self.status()
        ready = [one for one in status["replicas"] if one["phase"] == "ready"]
        return len(ready) == 2 and bool(status["answers"])


def machines(pool: Pool) -> set[str]:
    return set(os.listdir(pool.folder / "home/local/machines"))
