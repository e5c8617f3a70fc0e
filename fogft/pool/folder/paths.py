"""Where everything of a pool lies on disk, and nothing else about it.

``$FOGFT_HOME``, else ``$XDG_STATE_HOME/fogft``, else ``~/.local/state/fogft``. Folders
are 0700 and files 0600. Every file is written whole and renamed into place.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fogft import disk


def home(environ: Mapping[str, str] = os.environ) -> Path:
    """Return the folder that holds all of fogft's state for this user."""
    if environ.get("FOGFT_HOME"):
        return Path(environ["FOGFT_HOME"])
    state = environ.get("XDG_STATE_HOME")
    return (Path(state) if state else Path.home() / ".local" / "state") / "fogft"


def latency_file() -> Path:
    """Return the file that keeps this machine's distances to regions."""
    return home() / "latency.json"


@dataclass(frozen=True)
class PoolPaths:
    """The files of one pool; each has one writer.

    Written by `up`, `scale`, `drain`, `exclude` and `down` (under `intent_lock`):
    `identity`, `spec`, `intent`. By the manager (under `manager_lock`): `lease`,
    `status`, `membership`, `proxy_config`, `history`, `credentials`, `good_spec`, `trial`,
    `discovered`. By the client proxy (under `proxy_lock`): `proxy_status`.
    """

    folder: Path

    @classmethod
    def of(cls, name: str, root: Path | None = None) -> PoolPaths:
        """Return the paths of a pool by name, under `home()` unless told."""
        return cls((root or home()) / "pools" / name)

    @property
    def identity(self) -> Path:
        """``{name, uid, cloud, file, created_at}``: written once, at the first `up`."""
        return self.folder / "pool.json"

    @property
    def spec(self) -> Path:
        """The pool file as last applied, byte for byte."""
        return self.folder / "spec.yaml"

    @property
    def good_spec(self) -> Path:
        """The last pool file with which the pool was wholly ready, byte for byte."""
        return self.folder / "good.yaml"

    @property
    def trial(self) -> Path:
        """``{file, began_at, fault}``: what became of the file applied last."""
        return self.folder / "trial.json"

    @property
    def intent(self) -> Path:
        """What the user asked for besides the file (`fogft.pool.intent`)."""
        return self.folder / "intent.json"

    @property
    def intent_lock(self) -> Path:
        """Held while `identity`, `spec` or `intent` is changed."""
        return self.folder / "intent.lock"

    @property
    def manager_lock(self) -> Path:
        """Held by the manager as long as it lives."""
        return self.folder / "manager.lock"

    @property
    def lease(self) -> Path:
        """``{epoch, pid, beat}``: the active manager; `beat` grows while it works."""
        return self.folder / "lease.json"

    @property
    def status(self) -> Path:
        """The manager's last observation (`fogft.pool.manager.status`)."""
        return self.folder / "status.json"

    @property
    def membership(self) -> Path:
        """The membership that the client proxy follows, and its cache."""
        return self.folder / "membership.json"

    @property
    def discovered(self) -> Path:
        """Services that replicas told of, where the pool file lists none."""
        return self.folder / "discovered.json"

    @property
    def records(self) -> Path:
        """Records that the client proxy learned from a rendezvous."""
        return self.folder / "records.json"

    @property
    def manager_records(self) -> Path:
        """Records that the manager published or learned."""
        return self.folder / "manager-records.json"

    @property
    def announcements(self) -> Path:
        """What the manager has signed for all replicas; the client proxy passes it on to them."""
        return self.folder / "announcements.json"

    @property
    def history(self) -> Path:
        """One JSON object a line: launches, ends, refusals; the generations used."""
        return self.folder / "history.jsonl"

    @property
    def costs(self) -> Path:
        """What all pools of this user have cost, a file each, which stays when one has ended."""
        return self.folder.parent.parent / "costs"

    @property
    def credentials(self) -> Path:
        """Folder of the pool's CA and its certificates."""
        return self.folder / "credentials"

    @property
    def proxy_config(self) -> Path:
        """The client proxy's configuration."""
        return self.folder / "proxy.yaml"

    @property
    def proxy_lock(self) -> Path:
        """Held by the client proxy as long as it lives."""
        return self.folder / "proxy.lock"

    @property
    def standby_lock(self) -> Path:
        """Held by the client proxy that is to take over from the one that holds `proxy_lock`."""
        return disk.standby_lock(self.proxy_lock)

    @property
    def manager_start(self) -> Path:
        """``{command, folder}``: how to start a killed manager; gone when it ended well."""
        return self.folder / "manager.json"

    @property
    def proxy_status(self) -> Path:
        """What the client proxy reports: links and counters."""
        return self.folder / "proxy-status.json"

    @property
    def manager_log(self) -> Path:
        """The manager's log."""
        return self.folder / "manager.log"

    @property
    def proxy_log(self) -> Path:
        """The client proxy's log."""
        return self.folder / "proxy.log"
