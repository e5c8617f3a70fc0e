"""Paths of a pool's files on disk.

``$FOGFT_HOME``, else ``$XDG_STATE_HOME/fogft``, else ``~/.local/state/fogft``. Folders
are 0700 and files 0600. Files are written whole and renamed into place, except history and logs.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fogft import disk
from fogft.errors import StateError


def home(environ: Mapping[str, str] = os.environ) -> Path:
    """Return the folder that holds all of fogft's state for this user. Raises StateError."""
    if given := environ.get("FOGFT_HOME"):
        if os.path.lexists(given) and not os.path.isdir(given):
            raise StateError(f"`{given}` is not a folder", "set FOGFT_HOME to a folder")
        return Path(given)
    return own_folder("XDG_STATE_HOME", "~/.local/state", environ) / "fogft"


def own_folder(variable: str, default: str, environ: Mapping[str, str] = os.environ) -> Path:
    """Return a folder of this user's. Raises StateError: it has no home, as in a container."""
    found = environ.get(variable) or os.path.expanduser(default)
    if found.startswith("~"):
        raise StateError("this user has no home folder", "set HOME to a folder of its own")
    return Path(found)


def latency_file() -> Path:
    """Return the file that keeps this machine's distances to regions."""
    return home() / "latency.json"


class _File:
    """A file in the folder of `PoolPaths`."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, paths: PoolPaths, _owner: object) -> Path:
        return paths.folder / self._name


@dataclass(frozen=True)
class PoolPaths:
    """The files of one pool. A process holds its lock as long as it lives.

    Commands write `identity`, `spec` and `intent` (under `intent_lock`; ending a pool removes its
    `identity`), the client proxy writes `proxy_status` and `records` (under `proxy_lock`), and the
    manager writes all else (under `manager_lock`).
    """

    folder: Path

    @classmethod
    def of(cls, name: str, root: Path | None = None) -> PoolPaths:
        """Return the paths of a pool by name, under `root`, by default `home()`."""
        return cls((root or home()) / "pools" / name)

    identity = _File("pool.json")
    """``{name, uid, cloud, file, created_at}``: written once, at the first `up`."""
    exported = _File("exported.json")
    """`identity`, once another machine manages the pool."""
    spec = _File("spec.yaml")
    """The pool file as last applied, byte for byte."""
    good_spec = _File("good.yaml")
    """The last pool file with which the whole pool was ready, byte for byte."""
    trial = _File("trial.json")
    """``{file, began_at, fault}``: what became of the file applied last."""
    intent = _File("intent.json")
    """What the user asked for besides the file (`fogft.model.intent`)."""
    intent_lock = _File("intent.lock")
    """Held while `identity`, `spec` or `intent` is changed."""
    manager_lock = _File("manager.lock")
    lease = _File("lease.json")
    """``{epoch, beat}``: the active manager; `beat` grows while it works."""
    status = _File("status.json")
    """The manager's last observation (`fogft.pool.manager.status`)."""
    membership = _File("membership.json")
    """The membership that the client proxy follows, and its cache."""
    discovered = _File("discovered.json")
    """Services that replicas reported, if the pool file lists none."""
    gateway = _File("gateway.json")
    """The location of the gateway that the pool launched."""
    records = _File("records.json")
    """Records that the client proxy learned from a rendezvous."""
    manager_records = _File("manager-records.json")
    """Records that the manager published or learned."""
    announcements = _File("announcements.json")
    """Records that the manager signed for all replicas; the client proxy forwards them."""
    history = _File("history.jsonl")
    """One JSON object a line: launches, ends, refusals; the generations used."""
    credentials = _File("credentials")
    """Folder of the pool's CA and its certificates."""
    proxy_config = _File("proxy.yaml")
    proxy_lock = _File("proxy.lock")
    manager_start = _File("manager.json")
    """``{command, folder}``: how to start a killed manager; gone when it ended well."""
    proxy_status = _File("proxy-status.json")
    """What the client proxy reports: links and counters."""
    manager_log = _File("manager.log")
    proxy_log = _File("proxy.log")

    @property
    def standby_lock(self) -> Path:
        """Held by the standby client proxy, which takes over from the holder of `proxy_lock`."""
        return disk.standby_lock(self.proxy_lock)

    @property
    def spare_lock(self) -> Path:
        """Held by the spare, which takes the place of the holder of `standby_lock`."""
        return disk.standby_lock(self.standby_lock)

    @property
    def costs(self) -> Path:
        """The folder with the cost files of all pools, kept after a pool ends."""
        return self.folder.parent.parent / "costs"
