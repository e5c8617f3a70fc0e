"""SkyPilot settings that fogft applies to a launch, unless the user has set them.

A VM gets no credentials: SkyPilot's default is those of every cloud and, with any of them, its own
ssh key. On AWS a guard script ends a VM on which no replica runs: SkyPilot sets `autostop` only
once a machine is fully set up. A remote API server gets the guard, but decides on credentials.
"""

import base64
import importlib
import json
import threading
from collections.abc import Iterable
from typing import Any

from fogft import template_files
from fogft.cloud.sky import naming
from fogft.model.names import SETUP_LIMIT_S
from fogft.model.replica import ReplicaId

NO_UPLOAD, UPLOAD = "NO_UPLOAD", "LOCAL_CREDENTIALS"
ENDED_BY_FILES = frozenset({"nebius", "oci", "vast"})
"""Clouds whose VMs have no identity: a VM needs the cloud's credential files to end itself."""
GROUP = ("aws", "security_group_name")  # by patterns of cluster names
GUARD = ("aws", "post_provision_runcmd")  # part of the launch request itself
EACH_BOOT = "/var/lib/cloud/scripts/per-boot"
ALONE_MINUTES = 15 + SETUP_LIMIT_S // 60
"""A launch may take 15 minutes (`following.LAUNCH_LIMIT_S`), plus the limit for set-up."""
NO_REPORTS = "SKYPILOT_DISABLE_USAGE_COLLECTION"


def guard() -> str:
    """Return the shell line with which cloud-init installs and starts the guard, not waiting."""
    text = template_files.read_text("vm_guard.sh").replace("@ALONE_MINUTES@", str(ALONE_MINUTES))
    packed = base64.b64encode(text.encode()).decode()
    script = f"{EACH_BOOT}/fogft-guard"
    written = f"mkdir -p {EACH_BOOT} && echo {packed} | base64 -d > {script}"
    return f"{written} && chmod 755 {script} && {script}"


class Settings:
    """SkyPilot's settings, which are global to this process."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._set: dict[str, str] = {}  # cloud -> the value written here, not by the user
        self._launched: set[str] = set()

    def apply(self, clouds: Iterable[str], id: ReplicaId | None = None, group: str = "") -> None:
        """Apply a launch's settings on top of the user's own; `group`: its security group."""
        config = importlib.import_module("sky.skypilot_config")
        with self._lock:
            self._launched |= ENDED_BY_FILES.intersection(clouds)
            changes = [] if id is None else _with_group(config, id, group)
            given = list(config.get_nested(GUARD, []) or [])
            if guard() not in given:
                changes.append(f"{'.'.join(GUARD)}={json.dumps([*given, guard()])}")
            for cloud in () if _is_elsewhere() else _with_identity():
                wanted = UPLOAD if cloud in self._launched else NO_UPLOAD
                found = _identity(config, cloud)
                if found != wanted and found == self._set.get(cloud):
                    self._set[cloud] = wanted
                    changes.append(f"{cloud}.remote_identity={wanted}")
            if changes:
                config.apply_cli_config(changes)  # as `sky launch --config` does

    def uploaded(self, clouds: Iterable[str]) -> list[str] | None:
        """Return the credential files that a VM gets anyway; None: a remote API server decides."""
        self.apply(clouds)
        if _is_elsewhere():
            return None
        config = importlib.import_module("sky.skypilot_config")
        known = importlib.import_module("sky.utils.registry").CLOUD_REGISTRY
        kept = [one for name, one in known.items() if _identity(config, name) == NO_UPLOAD]
        mounts = importlib.import_module("sky.check").get_cloud_credential_file_mounts(kept)
        return sorted(mounts)


def _with_group(config: Any, id: ReplicaId, group: str) -> list[str]:
    """Return the setting that gives a pool's clusters a security group; empty if set already."""
    clusters = f"{naming.PREFIX}{id.pool_uid}-*"
    found = config.get_nested(GROUP, None) or []
    given = [{"*": found}] if isinstance(found, str) else list(found)
    wanted = [one for one in given if clusters not in one]
    if group:
        wanted.insert(0, {clusters: group})
    return [] if wanted == given else [f"{'.'.join(GROUP)}={json.dumps(wanted)}"]


def _is_elsewhere() -> bool:
    return not importlib.import_module("sky.server.common").is_api_server_local()


def _with_identity() -> list[str]:
    """Return the clouds that have `remote_identity` in SkyPilot's own schema."""
    schema = importlib.import_module("sky.utils.schemas").get_config_schema()
    parts = schema["properties"].items()
    return [name for name, part in parts if "remote_identity" in part.get("properties", {})]


def _identity(config: Any, cloud: str) -> Any:
    """Return a cloud's `remote_identity`, set in the active workspace or globally."""
    return config.get_effective_workspace_region_config(
        cloud=cloud.lower(), region=None, keys=("remote_identity",), default_value=None
    )
