"""Real clouds through SkyPilot's public SDK: a cluster for each replica. See docs/design/sky.md."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fogft.cloud.sky.adapter import SkyCloud


def make(folder: Path, base: Path) -> SkyCloud:
    """Return the real clouds of this user. Imports neither SkyPilot nor boto3 until it is asked."""
    import getpass
    import importlib.util
    import socket

    from fogft.cloud.sky.adapter import SkyCloud
    from fogft.cloud.sky.aws import Aws
    from fogft.cloud.sky.gcp import Gcp
    from fogft.cloud.sky.installed import InstalledSky

    owner = f"{getpass.getuser()}-{socket.gethostname()}"
    google = importlib.util.find_spec("google") and importlib.util.find_spec("google.auth")
    providers = [Aws(), Gcp()] if google else [Aws()]
    return SkyCloud(folder, InstalledSky(), providers, owner=owner, base=base)
