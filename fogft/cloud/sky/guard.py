"""What a VM does by itself from its first boot on: it ends where no replica ever runs on it.

SkyPilot sets `autostop` when a machine is wholly set up. Before that a machine whose launcher
dies, SkyPilot's API server with it, would run until somebody looks. SkyPilot hands the commands
of its setting `aws.post_provision_runcmd` to the machine with the order itself.

On AWS only: SkyPilot has no such setting for others.
"""

from __future__ import annotations

import base64

from fogft import template_files
from fogft.model.names import SETUP_LIMIT_S

SETTING = ("aws", "post_provision_runcmd")
ALONE_MINUTES = 15 + SETUP_LIMIT_S // 60
"""A launch takes 15 minutes at most (`following.LAUNCH_LIMIT_S`), a set-up its own limit."""


def command() -> str:
    """Return the command: one line, for a shell, which returns at once."""
    text = template_files.read_text("vm_guard.sh").replace("@ALONE_MINUTES@", str(ALONE_MINUTES))
    packed = base64.b64encode(text.encode()).decode()
    path = "/run/fogft-guard"
    return f"echo {packed} | base64 -d > {path} && setsid sh {path} > /dev/null 2>&1 &"
