"""What fogft has SkyPilot do at a launch, where the user's own settings do not say otherwise.

A VM gets the guard (`guard`), and no credentials: by SkyPilot's default it would get the files of
every cloud that they exist for, and with any of them SkyPilot's own ssh key. Usage reports are off.
A request carries these settings to the API server. To one elsewhere it carries the guard only:
which of its own credentials that server gives away its administrator has decided.

Not here: which roles and ports a VM has (`aws`, `task`).
"""

from __future__ import annotations

import importlib
import json
import os
import threading
from collections.abc import Iterable
from typing import Any

from fogft.cloud.sky import guard

NO_UPLOAD, UPLOAD = "NO_UPLOAD", "LOCAL_CREDENTIALS"
ENDED_BY_FILES = frozenset({"nebius", "oci", "vast"})
"""Clouds whose VMs have no identity of their own: to end itself one needs its cloud's files."""
NO_REPORTS = "SKYPILOT_DISABLE_USAGE_COLLECTION"


def report_nothing() -> None:
    """Turn SkyPilot's usage reports off, unless the user chose. Before it is imported."""
    os.environ.setdefault(NO_REPORTS, "1")


class Settings:
    """The settings of this process, which SkyPilot keeps for all of it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._set: dict[str, str] = {}  # cloud -> what was written here, and not by the user
        self._launched: set[str] = set()

    def apply(self, clouds: Iterable[str]) -> None:
        """Set what a launch on some clouds is to have; the user's own commands come first."""
        config = importlib.import_module("sky.skypilot_config")
        with self._lock:
            self._launched |= ENDED_BY_FILES.intersection(clouds)
            changes: list[str] = []
            given = list(config.get_nested(guard.SETTING, []) or [])
            if guard.command() not in given:
                value = json.dumps([*given, guard.command()])
                changes.append(f"{'.'.join(guard.SETTING)}={value}")
            for cloud in () if _is_elsewhere() else _with_identity():
                wanted = UPLOAD if cloud in self._launched else NO_UPLOAD
                found = _identity(config, cloud)
                if found != wanted and found == self._set.get(cloud):
                    self._set[cloud] = wanted
                    changes.append(f"{cloud}.remote_identity={wanted}")
            if changes:
                config.apply_cli_config(changes)  # as `sky launch --config` does

    def uploaded(self, clouds: Iterable[str]) -> list[str] | None:
        """Return the files of credentials that go to a VM on some clouds all the same.

        None: an API server elsewhere decides.
        """
        self.apply(clouds)
        if _is_elsewhere():
            return None
        config = importlib.import_module("sky.skypilot_config")
        known = importlib.import_module("sky.utils.registry").CLOUD_REGISTRY
        kept = [one for name, one in known.items() if _identity(config, name) == NO_UPLOAD]
        mounts = importlib.import_module("sky.check").get_cloud_credential_file_mounts(kept)
        return sorted(mounts)


def _is_elsewhere() -> bool:
    return not importlib.import_module("sky.server.common").is_api_server_local()


def _with_identity() -> list[str]:
    """Return the clouds for which SkyPilot's own schema knows the setting."""
    schema = importlib.import_module("sky.utils.schemas").get_config_schema()
    parts = schema["properties"].items()
    return [name for name, part in parts if "remote_identity" in part.get("properties", {})]


def _identity(config: Any, cloud: str) -> Any:
    """Return what is set for a cloud, in the workspace that is active or for all of them."""
    return config.get_effective_workspace_region_config(
        cloud=cloud.lower(), region=None, keys=("remote_identity",), default_value=None
    )
