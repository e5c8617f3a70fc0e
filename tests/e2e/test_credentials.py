"""A second robot from one file, new keys while requests flow, and the door closed on a robot."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from tests.e2e.pool import Client, Machine, Pool
from tests.freezing import freeze

pytestmark = [pytest.mark.e2e, pytest.mark.ros, pytest.mark.timeout(240)]


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


def test_two_robots_new_keys_and_a_revocation_lose_no_request(pool, ada):
    """Both robots use both replicas; then keys change twice over, and ada is shut out."""
    pool.wait(lambda: [link["state"] for link in links(ada)] == ["up", "up"])
    first = pool.client(120, 5)
    second = Client(ada.environ, 6, 10, 12.0)
    result = second.result()
    assert result["requests"] > 40
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


def pool_said(pool: Pool, *words: str) -> str:
    """Run a command; return all that it prints."""
    return pool.fogft(*words, ok=False)


def secrets_told(pool: Pool, ada: Machine) -> list[str]:
    """Return where a key or the passphrase stands that is no key's own file (0600)."""
    files = [path for path in pool.folder.rglob("*") if path.is_file() and path.name != "secret"]
    keys = [path for path in files if path.suffix == ".key"]
    secrets = {path.read_bytes().splitlines()[2] for path in keys} | {b"a passphrase that nobody"}
    open_to_others = [str(path) for path in keys if path.stat().st_mode & 0o077]
    told = [
        str(path)
        for path in files
        if path not in keys
        and path.name != "secret"
        and any(s in path.read_bytes() for s in secrets)
    ]
    lines = [
        Path(f"/proc/{pid}/cmdline").read_bytes() for pid in [*pool.processes(), ada.process.pid]
    ]
    status = pool.fogft("status", "--json").encode()
    return (
        open_to_others + told + [repr(t) for t in (*lines, status) if any(s in t for s in secrets)]
    )
