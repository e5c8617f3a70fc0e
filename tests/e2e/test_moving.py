"""`fogft export` and `fogft import`: a pool moves to another machine while a client asks."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from tests.e2e.pool import Pool

pytestmark = [pytest.mark.e2e, pytest.mark.ros, pytest.mark.timeout(400)]
SECRET = "a passphrase that unknown"


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


def test_a_pool_moves_under_load_and_is_managed_by_one_machine_only(pool: Pool) -> None:
    """No request is lost, no replica replaced, and the old machine can do nothing to it.

    Nor can another one that imports a copy: either that or the first is told, and steps back.
    """
    pool.write(replicas=2)
    pool.up()
    secret, file = pool.folder / "secret", pool.folder / "e2e.pool"
    secret.write_text(f"{SECRET}\n")
    given = ("--passphrase-file", str(secret))
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
